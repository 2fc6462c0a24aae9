"""Beyond the paper: a rigid body with contact damping on SO(3), by the Moser–Veselov step with a conformal factor.

L = ½ Ω·JΩ − γs on SO(3) × R, Ω the body angular velocity. With F = R_kᵀR_{k+1} and E = e^{−γh},

    L_d = (E − 1) s_k + (√E/h) tr((I − F) J_d),    J_d = ½ tr(J) I − J,    c = E,

and the discrete Herglotz equation, its derivatives taken to the left (body) frame, is

    F_k m_k = c M_k,    M_{k+1} = m_k,    with (h√E M_k)^ = F_k J_d − J_d F_kᵀ for FL⁻.

Hence R_{k+1}M_{k+1} = c R_k M_k: the spatial angular momentum keeps its direction and shrinks by c.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.newton import find_root
from herglotz.stepping.rollout import Drive, OneStep, Plan, roll_out
from herglotz.stepping.state import Status, Step, check_h, status_of_root, step_sizes


def hat(w: Tensor) -> Tensor:
    """The matrix of w ×, (..., 3) → (..., 3, 3)."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def cayley(f: Tensor) -> Tensor:
    """The rotation (I + f̂)(I − f̂)⁻¹ = I + 2(f̂ + f̂²)/(1 + |f|²) by θ = 2 arctan |f| < π about f (..., 3)."""
    F = hat(f)
    eye = torch.eye(3, dtype=f.dtype, device=f.device)
    return eye + 2.0 / (1.0 + (f * f).sum(-1))[..., None, None] * (F + F @ F)


class BodyState(NamedTuple):
    """A point of T*SO(3) × R, in the body frame."""

    R: Tensor  # (..., 3, 3) attitude, from body to space
    M: Tensor  # (..., 3) angular momentum JΩ
    s: Tensor  # (...) action variable


@dataclass(frozen=True)
class BodyRollout:
    """A motion of K steps; entry 0 is the start. NaN after a failed step."""

    R: Tensor  # (..., K+1, 3, 3)
    M: Tensor  # (..., K+1, 3)
    s: Tensor  # (..., K+1)
    sigma: Tensor  # (..., K+1) accumulated conformal factor
    status: Tensor  # (..., K)
    residual: Tensor  # (..., K)

    @property
    def ok(self) -> Tensor:
        """Whether every step converged, shape (...)."""
        return (self.status == Status.CONVERGED).all(-1)


class RigidBodyStepper:
    """Steps of a torque-free rigid body with damping rate γ.

    Parameters
    ----------
    inertia
        (3,) principal moments or (3, 3) symmetric inertia matrix J in the body frame, kg m².
    gamma
        Damping rate γ, 1/s.

    Raise InputError if J is not symmetric and positive.

    Source: section 6 of `docs/mathematics.md`.
    """

    def __init__(self, inertia: Tensor, gamma: float = 0.0):
        J = torch.diag(inertia) if inertia.ndim == 1 else inertia
        if J.shape != (3, 3) or not bool(torch.isfinite(J).all()) or not torch.equal(J, J.mT):
            raise InputError(f"inertia must be 3 moments or a symmetric (3, 3) matrix, got {inertia.tolist()}")
        if not bool((torch.linalg.eigvalsh(J) > 0).all()):
            raise InputError(f"inertia must be positive, its principal moments are {torch.linalg.eigvalsh(J).tolist()}")
        self.inertia, self.gamma = J, gamma

    def energy(self, M: Tensor) -> Tensor:
        """½ M·J⁻¹M, shape (...), J."""
        return 0.5 * (M * torch.linalg.solve(self.inertia.to(M.dtype), M[..., None])[..., 0]).sum(-1)

    def step(self, state: BodyState, h: Tensor | float) -> Step:
        """One step: solve FL⁻ for F → attitude → momentum → action. Differentiable with respect to the state and h.

        Samples whose status is not `Status.CONVERGED` are NaN: h|M| is too large for any F. Raise InputError if shapes
        or dtypes do not fit or h is not positive.
        """
        R, M, s = _checked(state)
        h = check_h(h, M)
        root = torch.exp(-0.5 * self.gamma * h)
        g = (h * root)[..., None] * M
        f, status, residual, iterations = self._solve(g)
        F = cayley(f)
        # tr((I − F) J_d) = 2 f·Jf/(1 + |f|²); the right-hand side has no cancellation.
        action = 2.0 * (f * (f @ self.inertia.to(f))).sum(-1) / (1.0 + (f * f).sum(-1))
        c = (root**2).expand_as(s)
        new = BodyState(
            _orthogonal(R @ F),
            c[..., None] * (F.mT @ M[..., None])[..., 0],
            s + torch.expm1(-self.gamma * h) * s + root / h * action,
        )
        return Step.of(new, c, status, residual, iterations)

    def rollout(
        self,
        R: Tensor,
        M: Tensor,
        s: Tensor | None = None,
        *,
        h: Tensor | float,
        steps: int | None = None,
        every: int = 1,
    ) -> BodyRollout:
        """Roll out from (R, M, s), s = 0 by default; `Stepper.rollout` explains h, steps and every."""
        state = _checked(BodyState(R, M, torch.zeros_like(M[..., 0]) if s is None else s))
        h_all = step_sizes(check_h(h, M), steps)
        single: OneStep = lambda state, h, *_: (self.step(state, h), None)  # noqa: E731
        track = roll_out(state, Drive(lambda: single, h_all, Plan(h_all.shape[-1], every), extrapolate=False))
        R, M, s = track.states
        return BodyRollout(R, M, s, track.sigma, track.status, track.residual)

    def _solve(self, g: Tensor) -> tuple[Tensor, Tensor, Tensor, int]:
        """The Cayley vector f of F with F J_d − J_d Fᵀ = ĝ, its status, last Newton step, and iterations.

        f solves the quadratic equation g + g × f + (g·f) f = 2 J f. The flow is the branch with f → ½ J⁻¹g as g → 0, so
        Newton's method starts at ½ J⁻¹g. The branch ends where the Jacobian is singular.
        """
        J2 = 2.0 * self.inertia.to(g)
        with torch.no_grad():
            start = torch.linalg.solve(J2, g.detach()[..., None])[..., 0]
            root = find_root(lambda f: _equation(g.detach(), J2, f), start, torch.ones_like(start))
            f = root.x
            # The equation has other roots, such as π − θ for θ. The branch of the flow ends before a quarter turn, and
            # at a fold, where the determinant changes sign.
            wanted = ((f * f).sum(-1) < 1.0) & (torch.linalg.det(root.J) < 0)
            status = status_of_root(root, torch.isfinite(f).all(-1), root.converged & ~wanted)
        return root.with_slope(lambda f: _equation(g, J2, f)[0]), status, root.error, root.iterations


def _equation(g: Tensor, J2: Tensor, f: Tensor) -> tuple[Tensor, Tensor]:
    """The residual E = g + g × f + (g·f) f − 2 J f and its derivative in f."""
    along = (g * f).sum(-1)
    E = g + torch.linalg.cross(g, f) + along[..., None] * f - f @ J2
    D = hat(g) + f[..., :, None] * g[..., None, :] - J2
    return E, D + along[..., None, None] * torch.eye(3, dtype=g.dtype, device=g.device)


def _orthogonal(R: Tensor) -> Tensor:
    """R(3I − RᵀR)/2: one Newton–Schulz step, which squares RᵀR − I, so that rounding does not accumulate."""
    return 1.5 * R - 0.5 * R @ (R.mT @ R)


def _checked(state: BodyState) -> BodyState:
    R, M, s = state
    if R.shape[-2:] != (3, 3) or M.shape[-1:] != (3,) or R.shape[:-2] != M.shape[:-1] or s.shape != M.shape[:-1]:
        shapes = [tuple(x.shape) for x in state]
        raise InputError(f"R, M, s need shapes (..., 3, 3), (..., 3), (...); got {shapes}")
    if not R.is_floating_point() or R.dtype != M.dtype or s.dtype != M.dtype:
        raise InputError(f"R, M and s need one floating-point dtype, got {R.dtype}, {M.dtype}, {s.dtype}")
    return BodyState(R, M, s)
