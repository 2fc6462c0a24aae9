"""Sample states of an L_d that comes without states: positions and velocities of size 1, momenta by FL⁻."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian, momentum_minus, partials
from herglotz.models import ContactLagrangian
from herglotz.stepping import State

# Largest number of coordinates that is tried on a function.
MAX_COORDINATES = 12


def drawn_states(L_d: DiscreteLagrangian, h: float, samples: int, make: torch.Generator) -> State:
    """Return (q0, p0, s0) with q0 and q̇ standard normal, s0 in [−1, 1], and p0 = −D1 L_d(q0, q0 + h q̇, s0)/c.

    A learned model provides the sizes of q and q̇ and the number of coordinates. A function is tried with 1, 2, …
    coordinates until it accepts the number, so a sum over coordinates is verified for one. Raise InputError if the
    function accepts no number up to 12, or gives no finite momentum.
    """
    if isinstance(L_d, ContactLagrangian):
        scale, speed = (torch.tensor(x, dtype=torch.float64) for x in (L_d.config.scale, L_d.config.speed))
        dtype = next(L_d.parameters()).dtype
        return _state(L_d, scale.to(dtype), speed.to(dtype), h, samples, make)
    refused = ""
    for n in range(1, MAX_COORDINATES + 1):
        one = torch.ones(n, dtype=torch.float64)
        try:
            return _state(L_d, one, one, h, samples, make)
        except (IndexError, RuntimeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            refused = str(error).splitlines()[0]
    raise InputError(
        f"no states could be drawn: up to {MAX_COORDINATES} coordinates the function fails ({refused}); "
        "give (L_d, (q, p, s))"
    )


def _state(
    L_d: DiscreteLagrangian, scale: Tensor, speed: Tensor, h: float, samples: int, make: torch.Generator
) -> State:
    shape = (samples, len(scale))
    q, v = (torch.randn(shape, generator=make, dtype=torch.float64).to(scale) * size for size in (scale, speed))
    s = (2 * torch.rand(samples, generator=make, dtype=torch.float64) - 1).to(scale) * (scale * speed).sum()
    with torch.no_grad():
        P = partials(L_d, q, q + h * v, s, h)
    p = momentum_minus(P)
    good = torch.isfinite(P.L) & torch.isfinite(p).all(-1)
    if not bool(good.any()):
        raise InputError("L_d has no finite momentum at q, q̇ of size 1; give states: (L_d, (q, p, s))")
    return State(q[good], p[good], s[good])
