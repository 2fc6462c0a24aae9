"""One step of the flow Φ̃ as a plain graph of tensor operations: what an exported file contains."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.errors import InputError
from herglotz.mechanics import Partials, momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian
from herglotz.stepping import Status, solve

TOLERANCE = 64  # machine epsilons: the eager stepper's tolerance
FLOOR = 1000  # machine epsilons: rounding in J⁻¹F that no further iteration removes


class StepModule(nn.Module):
    """(q, p, s, h) → (q1, p1, s1, c, residual, status), by a fixed number of Newton iterations on FL⁻.

    Built on the model's closed-form partials, so that nothing in the graph differentiates. A sample that has converged
    is frozen, except in the last iteration: that one moves q1 by rounding only, but its derivative is −J⁻¹ dF, so
    autograd through the graph gives the derivative of the implicit-function theorem.

    Parameters
    ----------
    model
        The discrete Lagrangian; not copied.
    iterations
        Newton iterations that are unrolled, at least 2.
    """

    def __init__(self, model: ContactLagrangian, iterations: int):
        super().__init__()
        if iterations < 2:
            raise InputError(f"newton_iterations must be at least 2, got {iterations}; 8 suits most models")
        self.model = model
        self.iterations = iterations

    def forward(
        self,
        q: Tensor,  # (B, n)
        p: Tensor,  # (B, n)
        s: Tensor,  # (B,)
        h: Tensor,  # (B,)
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """One step: guess → Newton → momentum → action.

        Returns
        -------
        tuple of Tensor
            q1 (B, n), p1 (B, n), s1 (B,), c (B,), residual |J⁻¹F| (B,) in units of q, status (B,) uint8. NaN in the
            samples whose status is not `Status.CONVERGED`.
        """
        eps = torch.finfo(q.dtype).eps
        q1 = q
        move = self._newton_move(self.model.partials(q, q1, s, h, order=2), p)
        scale = torch.maximum(_length(q), _length(move))  # as the eager solver has it
        for _ in range(self.iterations - 1):
            q1 = torch.where((_length(move) <= TOLERANCE * eps * scale)[..., None], q1, q1 + move)
            move = self._newton_move(self.model.partials(q, q1, s, h, order=2), p)
        q1 = q1 + move
        P = self.model.partials(q, q1, s, h, order=2)
        residual = _length(self._newton_move(P, p))
        status = _status(P, p, residual, FLOOR * eps * scale)
        nan = torch.where(status == Status.CONVERGED, 0.0, torch.nan).to(q.dtype)
        return q1 + nan[..., None], momentum_plus(P) + nan[..., None], s + P.L + nan, P.c + nan, residual, status

    @staticmethod
    def _newton_move(P: Partials, p: Tensor) -> Tensor:
        """−J⁻¹F, shape (B, n)."""
        return -solve(momentum_jacobian(P, p), momentum_residual(P, p))


def _status(P: Partials, p: Tensor, residual: Tensor, floor: Tensor) -> Tensor:
    """The status of each sample by the rules of the eager solver, uint8."""
    finite = torch.isfinite(_length(momentum_residual(P, p))) & torch.isfinite(P.L)
    status = torch.where(residual <= floor, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
    status = torch.where(torch.isfinite(residual) & (P.c != 0), status, int(Status.SINGULAR))
    return torch.where(finite, status, int(Status.DIVERGED)).to(torch.uint8)


def _length(x: Tensor) -> Tensor:
    return x.abs().amax(-1)
