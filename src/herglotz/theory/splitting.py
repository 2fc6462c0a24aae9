"""Contact splitting: H = |p|²/2m + V(q) + f(s) stepped by its three exact flows, without a solve.

damp:   ṡ = −f(s), ṗ = −f′(s)p, so s ↦ ψ_h(s) and p ↦ ψ_h′(s) p;      kick:  p ↦ p − hV′(q), s ↦ s − hV(q);
drift:  q ↦ q + hp/m, s ↦ s + h|p|²/2m.      Step: damp(h/2) kick(h/2) drift(h) kick(h/2) damp(h/2).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.stepping.method import OneStepMethod
from herglotz.stepping.state import State, Status, Step, check_h, check_state
from herglotz.theory.continuous import gradient

Scalar = Callable[[Tensor], Tensor]  # (..., n) → (...)
Damping = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # (s, h) → ψ_h(s) and ψ_h′(s)


def linear_damping(gamma: float) -> Damping:
    """f(s) = γs: ψ_h(s) = e^{−γh}s."""

    def damp(s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        E = torch.exp(-gamma * h)
        return E * s, E.expand_as(s)

    return damp


class ContactSplitting(OneStepMethod):
    """The explicit stepper of order 2 for H = |p|²/2m + V(q) + f(s); its own adjoint, so `suzuki` and others raise it.

    Parameters
    ----------
    potential
        V(q), shape (...).
    m
        Mass.
    damping
        γ of f(s) = γs, or the exact flow of ṡ = −f(s): a function (s, h) → (ψ_h(s), ψ_h′(s)) for h of either sign.
    force
        −V′(q), (..., n), where written out; else by autograd.

    Raises
    ------
    InputError
        If m ≤ 0.

    Source: section 5, trap 1 of `docs/mathematics.md`; A. Bravetti, M. Seri, M. Vermeeren, F. Zadra, Celest. Mech. Dyn.
    Astr. 132 (2020) 7.
    """

    def __init__(self, potential: Scalar, m: float, damping: float | Damping, force: Scalar | None = None):
        if not m > 0:
            raise InputError(f"ContactSplitting: mass m must be > 0, got {m}")
        self.potential, self.m = potential, m
        self.damp = damping if callable(damping) else linear_damping(damping)
        self.force = force if force is not None else lambda q: -gradient(potential, q)[1]

    def L_d(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """The discrete Lagrangian of the step: ψ(ψ(s0) + m|Δ|²/2h − (h/2)(V0 + V1)) − s0 with ψ = ψ_{h/2}."""
        delta = q1 - q0
        action = 0.5 * self.m / h * (delta * delta).sum(-1) - 0.5 * h * (self.potential(q0) + self.potential(q1))
        return self.damp(self.damp(s0, 0.5 * h)[0] + action, 0.5 * h)[0] - s0

    def substep(self, state: State, h: Tensor) -> Step:
        """One step over h of either sign."""
        (q0, p, s), half = state, 0.5 * h
        s, c0 = self.damp(s, half)
        p = c0[..., None] * p + half[..., None] * self.force(q0)
        q1 = q0 + h[..., None] * p / self.m
        s = s + h * (p * p).sum(-1) / (2 * self.m) - half * (self.potential(q0) + self.potential(q1))
        s, c1 = self.damp(s, half)
        p = c1[..., None] * (p + half[..., None] * self.force(q1))
        finite = torch.isfinite(q1).all(-1) & torch.isfinite(p).all(-1) & torch.isfinite(s)
        status = torch.where(finite, int(Status.CONVERGED), int(Status.DIVERGED)).to(torch.uint8)
        return Step.of(State(q1, p, s), c0 * c1, status, torch.zeros_like(s), 0)

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:  # noqa: ARG002
        """One step of h > 0, scalar or (...); nothing is guessed."""
        state = check_state(state)
        return self.substep(state, check_h(h, state.q))
