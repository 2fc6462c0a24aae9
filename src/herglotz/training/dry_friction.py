"""Whether dry friction holds a driven machine: a linear model of the accelerations with and without it.

Accelerations by differences are regressed on stiffness, friction that is viscous and quadratic, inputs and, in one of
two models, the sign of each velocity. Blocks of time that the regression has not seen tell whether the sign is needed.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.least_squares import least_squares
from herglotz.training.baseline import Differences, differences

BLOCKS = 10  # of time, each predicted from the others
# The mean of log(error without / error with) over blocks. Measured: 0.23 to 2.1 (3.2 to 14 standard errors) on an axis
# with dry friction at three sampling rates and on `servo_axis` with noise up to 1e-5; -0.12 to 0.02 on fourteen
# recordings and scenes without, or where noise hides friction.
WORTH = 0.1
CLEARLY = 2.0  # standard errors over blocks


def acceleration_terms(data: Trajectories) -> Differences:
    """Stiffness, tilt, damping and inputs as `estimate_baseline` has them, and a little more of each coordinate's own.

    Each coordinate has its own second harmonics (angles) or powers (lengths), viscous and quadratic friction.
    """
    found = differences(data)
    own = []
    for q, w, angle in zip(found.triples.q1.T, found.v.T, data.angles, strict=True):
        waves = [(2 * q).sin(), (2 * q).cos()] if angle else [q.square(), q**3]
        own.append(torch.stack([*waves, w, w * w.abs()], -1))
    return found._replace(columns=torch.cat([found.columns, for_each(torch.stack(own, 1))], -1))


def for_each(own: Tensor) -> Tensor:
    """Columns (T, n, k) of each coordinate in its own equation, with coefficients of its own, (T, n, n k)."""
    return (torch.eye(own.shape[1]).to(own)[:, :, None] * own[:, None]).flatten(2)


def friction_holds(train: Trajectories) -> tuple[bool, str]:
    """Whether dry friction is found in these data, and the numbers that say so."""
    _, v, a, columns, _ = acceleration_terms(train)
    without, _ = _held_out(columns, a)
    with_sign, x = _held_out(torch.cat([columns, torch.diag_embed(v.sign())], -1), a)
    gain = (without / with_sign.clamp_min(torch.finfo(with_sign.dtype).tiny)).log()
    clear = float(gain.mean() / gain.std().clamp_min(torch.finfo(gain.dtype).tiny)) * BLOCKS**0.5
    brakes = bool((x[-train.dof :] < 0).all())
    less = 1 - float((-gain.mean() / 2).exp())
    verb = "lowers" if less >= 0 else "raises"
    numbers = f"the sign of the velocity {verb} the error of held-out accelerations by {abs(100 * less):.2g} %"
    return float(gain.mean()) > WORTH and clear > CLEARLY and brakes, f"{numbers} ({abs(clear):.1f} standard errors)"


def _held_out(columns: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
    """Mean squares over blocks of time, each predicted from the others, (BLOCKS,), and the coefficients of them all."""
    A, y = columns.flatten(0, 1).cpu(), a.reshape(-1, 1).cpu()
    size = A.square().mean(0).sqrt().clamp_min(torch.finfo(A.dtype).tiny)
    A = A / size
    block = torch.arange(len(y)) * BLOCKS // len(y)
    errors = []
    for k in range(BLOCKS):
        seen = block != k
        x = least_squares(A[seen], y[seen])
        errors.append((A[~seen] @ x - y[~seen]).square().mean())
    return torch.stack(errors), least_squares(A, y)[:, 0] / size
