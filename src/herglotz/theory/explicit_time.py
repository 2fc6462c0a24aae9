"""The conclusions: explicit time, L_d(q0, q1, s0, t0, h) for a step that begins at t0 (cocontact mechanics).

The discrete Herglotz equations are those of L_d^k = L_d(·, ·, ·, t_k, h_k), one Lagrangian for each step. The momenta
of time are the energies at the ends of a step, with t1 = t0 + h:

    E⁻ = (∂_t L_d − ∂_h L_d)/c    at t0, as p0 = −D1/c,        E⁺ = −∂_h L_d    at t1, as p1 = D2,

A step conserves the form η + E dt up to the factor c, and not η alone:

    ds1 − p1·dq1 + E⁺dt1 = c (ds0 − p0·dq0 + E⁻dt0)            and    E⁺ = c E⁻ − ∂_t L_d,

The second equation is the discrete Ė = −R(H)E + ∂_t H. With an exact L_d both energies are H(q, p, s, t); with a rule
of order r, E⁺ of a step and E⁻ of the next differ by O(h^r). S^{k+1}(q_{k+1}, t_{k+1}) follows from S^k by the discrete
Hamilton–Jacobi equation with the H⁺ of L_d^k, and ∂S/∂t_{k+1} = −E⁺ is the discrete S_t + H(q, S_q, S, t) = 0.

Source: M. de León, J. Gaset, X. Gràcia, M. C. Muñoz-Lecanda, X. Rivas, Time-dependent contact mechanics, Monatsh. Math.
201 (2023) 1149, for cocontact systems; section 6 of `docs/mathematics.md`, time-dependent L_d.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import jacobian
from herglotz.mechanics.partials import gradient, partials
from herglotz.stepping import Rollout, State, Stepper
from herglotz.stepping.state import Step

TimeLagrangian = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class TimeDependent:
    """The family of L_d^k of an L_d(q0, q1, s0, t0, h); called, it is the L_d^k of the step that begins at `t0`.

    A stepper takes the times t_k as inputs: `Stepper(family).step(state, h, u=t[..., None])`.
    """

    L_d: TimeLagrangian
    t0: Tensor | float = 0.0  # () or (...)

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d of the step that begins at `t0`, shape (...)."""
        return self.L_d(q0, q1, s0, torch.as_tensor(self.t0, dtype=q0.dtype, device=q0.device), h)

    def at(self, u: Tensor) -> TimeDependent:
        """The L_d of a step that begins at u, (..., 1)."""
        if u.shape[-1:] != (1,):
            raise InputError(f"the input of a time-dependent L_d is its time t0, shape (..., 1); got {tuple(u.shape)}")
        return TimeDependent(self.L_d, u[..., 0])

    def step_at(self, state: State, t0: Tensor | float, h: Tensor | float) -> Step:
        """One step from t0 to t0 + h."""
        t = torch.as_tensor(t0, dtype=state.q.dtype, device=state.q.device)
        return Stepper(self).step(state, h, u=t.expand(state.s.shape)[..., None])

    def rollout(self, state: State, t0: float, h: float, steps: int, **settings: object) -> Rollout:
        """Roll out `steps` equal steps from t0; the settings are those of `Stepper.rollout`."""
        t = t0 + h * torch.arange(steps, dtype=state.q.dtype, device=state.q.device)
        return Stepper(self).rollout(*state, h=h, steps=steps, inputs=t[:, None], **settings)  # type: ignore[arg-type]


def energies(
    L_d: TimeLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    t0: Tensor | float,  # () or (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor]:
    """E⁻ at t0 and E⁺ at t0 + h of one step, (...) each, in units of p·v."""
    t, size = (torch.as_tensor(x, dtype=q0.dtype, device=q0.device).expand(s0.shape) for x in (t0, h))
    _, slope, _ = gradient(lambda x: L_d(q0, q1, s0, x[..., 0], x[..., 1]), torch.stack([t, size], -1))
    rate_t, rate_h = slope.unbind(-1)
    c = partials(TimeDependent(L_d, t0), q0, q1, s0, h).c
    return (rate_t - rate_h) / c, -rate_h


def time_defect(
    family: TimeDependent,
    state: State,
    t0: Tensor | float,  # () or (...)
    h: float,
) -> tuple[Tensor, Tensor]:
    """The dt0 and dh components of ds1 − p1·dq1 + E⁺dt1 − c (ds0 − p0·dq0 + E⁻dt0), (...) each.

    Both are zero for the step of L_d. The step is differentiated with respect to its time and its length; p1 and the
    energies come from L_d alone.
    """
    L_d, time = family.L_d, torch.as_tensor(t0, dtype=state.q.dtype).expand(state.s.shape)

    def moved(x: Tensor) -> Tensor:
        q, _, s = family.step_at(state, x[..., 0], x[..., 1]).state
        return torch.cat([q, s[..., None]], -1)

    end, D = jacobian(moved, torch.stack([time, torch.full_like(time, h)], -1))
    q1 = end[..., :-1].detach()
    P = partials(TimeDependent(L_d, time), state.q, q1, state.s, h)
    before, after = energies(L_d, state.q, q1, state.s, time, h)
    slopes = D[..., -1, :] - (P.D2[..., None, :] @ D[..., :-1, :])[..., 0, :]
    return (slopes[..., 0] + after - P.c * before).detach(), (slopes[..., 1] + after).detach()
