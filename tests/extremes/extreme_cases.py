"""Models, starts and the one question that every extreme asks: is anything not finite without a status?"""

from typing import Any

import torch

from herglotz.models import ModelConfig
from herglotz.stepping import State, Status
from tests.lagrangians import random_model

LEVELS: dict[str, dict[str, Any]] = {
    "explicit": {},
    "correction": {"correction_width": 6},
    "affine": {"level": "affine"},
    "full": {"level": "full"},
    "forced": {"level": "forced", "coulomb": True},
    "mass": {"mass_width": 4},
}
# What a user tells as text; two coordinates at least.
TOLD: dict[str, dict[str, Any]] = {
    "central": {"dof": 2, "angles": (False, False), "features": ("central",), "alike": True, "potential_width": 0},
    "pendulums": {"dof": 2, "features": ("pendulums",), "potential_width": 0},
    "order 4": {"dof": 2, "features": ("pendulums",), "potential_width": 0, "order": 4},
}


def build(noise=0.0, *, dtype=torch.float64, draw=0, dof=1, **settings: Any) -> Any:
    """A model with random weights of the given size."""
    if dof > 1:
        ones = (1.0,) * dof
        sizes: dict[str, Any] = {"scale": ones, "speed": ones, "stiffness": ones, "tilt": (0.0,) * dof}
        settings = {"angles": (True,) * dof} | sizes | settings
    return random_model(ModelConfig(**settings), dtype, noise, draw)


def state(q, p, s=0.0, dtype=torch.float64) -> State:
    """Lists of positions and momenta as a state (1, n), or (B, n) from lists of lists."""
    q, p = (torch.atleast_2d(torch.tensor(x, dtype=dtype)) for x in (q, p))
    return State(q, p, torch.full_like(q[..., 0], s))


def starts(batch, dtype=torch.float64, dof=1) -> State:
    make = torch.Generator().manual_seed(1)
    q, p = torch.randn(2, batch, dof, generator=make, dtype=torch.float64).to(dtype)
    return State(q, p, torch.zeros_like(q[..., 0]))


def assert_nothing_silent(out) -> None:
    """Finite exactly where every step so far converged, and NaN from the first failure on."""
    x = torch.cat([out.q, out.p, out.s[..., None], out.sigma[..., None]], -1)[..., 1:, :]
    converged = (out.status == Status.CONVERGED).cummin(-1).values
    assert torch.equal(torch.isfinite(x).all(-1), converged)
    assert bool(x[~converged].isnan().all())
