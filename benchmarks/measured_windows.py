"""Windows of a measured run that the fit has not seen, each started from positions and velocities of the record.

* driven_pendulum: two runs of the DFKI motor train, the third tests: free runs over 120 windows with the measured
  torque, from the same start states as the authors' identified model.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from herglotz.data import Trajectories, load
from herglotz.models import ContactLagrangian
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, fit

DFKI = tuple(
    f"dfki_pendulum/control_method_{name}__data_measured.csv"
    for name in ("energy_shaping", "pd__system_identification", "sac")
)
# The authors' identification: tau = J q'' + mgl sin q + b q' + c atan(100 q') + offset.
J, MGL, VISCOUS, COULOMB, OFFSET = 6.259e-2, 1.022e-1 * 9.81, 4.707e-2, 1.839e-1, -7.586e-2


def starts(data: Trajectories, rows: Tensor, beside: int = 8) -> tuple[Tensor, Tensor]:
    """Positions and velocities at samples, (W, n) each, by cubics through their neighbours: the same for all models."""
    near = rows[:, None] + torch.arange(-beside, beside + 1)
    x = data.t[near] - data.t[rows][:, None]
    c = torch.linalg.lstsq(torch.stack([x**k for k in range(4)], -1), data.q[near]).solution
    return c[:, 0], c[:, 1]


def momenta(model: ContactLagrangian, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
    """Momenta p = ∂L/∂v at (q, v), from D2 of a very short step that ends at q."""
    h = torch.full_like(s, 1e-4)
    return model.partials(q - 1e-4 * v, q, s, h).D2


def window_rows(data: Trajectories, steps: int, count: int = 120) -> Tensor:
    return torch.linspace(10, data.samples - steps - 11, count).round().long()


def driven_pendulum(seed: int, folder: Path) -> dict[str, float]:
    every = (4, 6, 4)  # 20 ms, as far as a step is 5 or 3.3 ms
    runs = [load(folder / name).with_angles("position").thinned(m) for name, m in zip(DFKI, every, strict=True)]
    *train, test = runs
    run = fit(Trajectories.cat(train), FitConfig(train_fraction=1.0, seed=seed), progress=False)
    found: dict[str, float] = {"segment_steps": run.metrics["segment_steps"]}
    for seconds in (0.5, 1.0, 2.0):
        found |= beside_the_authors(run.model, test, seconds)
    return found


def beside_the_authors(model: ContactLagrangian, test: Trajectories, seconds: float) -> dict[str, float]:
    """RMS over windows of free runs under the recorded input, ours and theirs, and in what share ours is nearer."""
    assert test.u is not None
    steps = round(seconds / test.typical_step)
    rows = window_rows(test, steps)
    q, v = starts(test, rows)
    at = rows[:, None] + torch.arange(steps + 1)
    h, u, truth = test.t[at].diff(dim=1), test.u[at[:, :-1]], test.q[at][..., 0]
    s = torch.zeros_like(q[:, 0])
    with torch.no_grad():
        ours = Stepper(model).rollout(q, momenta(model, q, v, s), s, h=h, inputs=u).q[..., 0]
    miss = {"ours": ours - truth, "authors": authors(q[:, 0], v[:, 0], h, u[..., 0]) - truth}
    rms = {name: float(x.square().mean().sqrt()) for name, x in miss.items()}
    one = {name: x.square().mean(1).sqrt() for name, x in miss.items()}
    return {
        **{f"{name}_rms_{seconds}s": value for name, value in rms.items()},
        **{f"{name}_median_{seconds}s": float(x.median()) for name, x in one.items()},
        f"over_authors_{seconds}s": rms["ours"] / rms["authors"],
        f"nearer_{seconds}s": float((one["ours"] < one["authors"]).double().mean()),
    }


def authors(q: Tensor, v: Tensor, h: Tensor, u: Tensor, parts: int = 4) -> Tensor:
    """Free runs of the authors' model by the midpoint rule, (W, K + 1)."""

    def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return (u - MGL * q.sin() - VISCOUS * v - COULOMB * (100 * v).atan() - OFFSET) / J

    out = [q]
    for k in range(h.shape[1]):
        for _ in range(parts):
            d = h[:, k] / parts
            middle = v + d / 2 * acceleration(q, v, u[:, k])
            v = v + d * acceleration(q + d / 2 * v, middle, u[:, k])
            q = q + d * middle
        out.append(q)
    return torch.stack(out, 1)
