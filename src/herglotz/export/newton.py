"""One iteration of Newton on the step equation as tensor operations; a file's own loop repeats the iteration.

The unknown is Δ = q1 − q0, because the difference q1 − q0 would round a small step away; where dry friction can hold a
coordinate it is the z of `herglotz.stepping.stick_slip`. The rules of acceptance are those of
`herglotz.mechanics.newton`, whose loop a file cannot hold: that loop decides in Python, for all samples at once,
whether the last Jacobian still serves and whether a trial was refused at all. Without these decisions it takes 1.3 to
1.6 times as long for 16 samples and 1.6 to 1.9 times for 1024 (n = 2, 16×2, levels linear, affine and full).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.export.equation import StepEquation, dense, length
from herglotz.export.metadata import TOLERANCE
from herglotz.models import ContactLagrangian
from herglotz.stepping import Status

FLOOR = 1000  # machine epsilons of q: rounding in J⁻¹F that no further iteration removes
ITERATIONS = 30  # default bound; a step from a good guess takes two to four
DECREASE = 1e-4  # share of the predicted decrease of |F| that an accepted trial must reach (Armijo's rule)
CARRIED = 10  # tensors between two iterations: count, done, x, delta, merit, fraction, scale, p1, L, c
# Tracing takes plain numbers, not the enumeration.
CONVERGED, MAX_ITERATIONS = int(Status.CONVERGED), int(Status.MAX_ITERATIONS)
SINGULAR, DIVERGED, BAD_INPUT = int(Status.SINGULAR), int(Status.DIVERGED), int(Status.BAD_INPUT)

Values = tuple[Tensor, ...]


def first_carry(guess: Tensor) -> Values:
    """The carry before iteration 0, which evaluates the guess of Δ, (B, n)."""
    zero = torch.zeros_like(guess[:, 0])
    return (
        torch.zeros((), dtype=torch.int64, device=guess.device),  # count
        torch.zeros_like(zero, dtype=torch.bool),  # done
        guess,  # x: the accepted Δ
        torch.zeros_like(guess),  # delta: the Newton step from x
        torch.full_like(zero, torch.inf),  # merit: |F| at x
        torch.ones_like(zero),  # fraction of delta that is tried next
        length(guess),  # scale: the size that the tolerance is relative to
        torch.zeros_like(guess),  # p1
        zero,  # L
        torch.zeros_like(zero),  # c
    )


class NewtonIteration(nn.Module):
    """One iteration with backtracking, one evaluation of the step equation."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.equation = StepEquation(model, model.capabilities.sticking)
        self.speed = max(model.config.speed)  # the networks' rounding is relative to h times this speed, even at rest

    def forward(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, *rest: Tensor) -> Values:
        """The next carry; `rest` is the carry, then V, V′ at q, u, K and w/K as far as the model has them."""
        (count, done, x, delta, merit, fraction, scale, *values), more = rest[:CARRIED], rest[CARRIED:]
        eps = torch.finfo(q.dtype).eps
        first = count == 0
        trial = x + torch.where(done[:, None], 0.0, fraction[:, None] * delta)
        delta_trial, size, merit_trial, *values_trial, _ = self.equation(q, p, s, h, trial, *more)
        left = length(delta_trial)
        scale = torch.where(first, torch.nan_to_num(torch.maximum(scale + size, left), nan=1.0, posinf=1.0), scale)
        better = first | (merit_trial <= (1 - DECREASE * fraction) * merit)
        settled = left <= TOLERANCE * eps * scale
        rounding = FLOOR * eps * torch.maximum(torch.maximum(scale, length(q)), self.speed * h)
        stalled = ~better & (length(delta) <= rounding)  # rounding, not a wrong direction
        # No direction to follow; as in `status_of`, for a sum of two large numbers may overflow where neither does.
        hopeless = first & ~(torch.isfinite(merit_trial) & torch.isfinite(left))
        accept = ~done & (better | settled)
        pairs = zip((trial, delta_trial, merit_trial, *values_trial), (x, delta, merit, *values), strict=True)
        x, delta, merit, *values = (torch.where(accept[:, None] if a.ndim > 1 else accept, a, b) for a, b in pairs)
        fraction = torch.where(accept, 1.0, fraction / 2)
        found = (done | settled | stalled | hopeless, x, delta, merit, fraction, scale, *values)
        return count + 1, *(dense(y) for y in found)


def unfinished(count: Tensor, done: Tensor, iterations: int) -> Tensor:
    """Whether another iteration is needed, a scalar bool."""
    return (count <= iterations) & ~done.all()


def status_of(h: Tensor, merit: Tensor, residual: Tensor, done: Tensor, L: Tensor, c: Tensor) -> Tensor:
    """The status of each sample by the rules of the eager solver, uint8; BAD_INPUT where h is no step."""
    status = torch.where(done, CONVERGED, MAX_ITERATIONS)
    status = torch.where(torch.isfinite(residual) & (c != 0), status, SINGULAR)
    status = torch.where(torch.isfinite(merit) & torch.isfinite(L), status, DIVERGED)
    return torch.where((h > 0) & torch.isfinite(h), status, BAD_INPUT).to(torch.uint8)
