"""Steps that keep the energy: discrete evolution (thermodynamic) dynamics of a contact Hamiltonian H(q, p, s).

    x1 = x0 + h B(x̄) ∇̄H,    B = [[0, I, 0], [−I, 0, −p], [0, pᵀ, 0]],    x = (q, p, s)

with a discrete gradient ∇̄H. B is antisymmetric, so H(x1) = H(x0). Minus h H̄ ∂_s, H̄ = (H0 + H1)/2, it is a step for
the contact field X_H, along which H1 − H0 = −h H̄ ∇̄_sH exactly. Neither is a contact map: `Stepper` is.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.newton import attached, find_root
from herglotz.stepping.method import OneStepMethod
from herglotz.stepping.state import State, Step, check_h, check_state, status_of_root, throw_failure
from herglotz.theory.continuous import Hamiltonian, contact_vector_field, evolution_vector_field, square_jacobian
from herglotz.theory.discrete_gradient import DiscreteGradient, midpoint_gradient
from herglotz.theory.jacobi import join, sharp_bivector, split

FIELDS = {"evolution": evolution_vector_field, "contact": contact_vector_field}


class EvolutionStepper(OneStepMethod):
    """Second-order, implicit steps of E_H or X_H by a discrete gradient.

    Parameters
    ----------
    H
        Contact Hamiltonian (q, p, s) → (...), batched.
    field
        "evolution" for E_H (H is kept) or "contact" for X_H (H shrinks by the factor c that the step reports).
    discrete_gradient
        `midpoint_gradient`, `increment_gradient` or `mean_value_gradient`.
    max_iterations
        Bound on Newton iterations (backtracking included).
    throw
        Raise `StepError` at the first sample that fails, instead of reporting its status.

    Raises
    ------
    InputError
        If `field` is neither of the two.

    Source: section 6 of `docs/mathematics.md`.
    """

    def __init__(
        self,
        H: Hamiltonian,
        *,
        field: str = "evolution",
        discrete_gradient: DiscreteGradient = midpoint_gradient,
        max_iterations: int = 30,
        throw: bool = False,
    ):
        if field not in FIELDS:
            raise InputError(f"unknown field '{field}'; choose one of {', '.join(FIELDS)}")
        self.H = H
        self.field = field
        self.discrete_gradient = discrete_gradient
        self.max_iterations = max_iterations
        self.throw = throw

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:  # noqa: ARG002
        """One step. Differentiable once with respect to the state, by the implicit-function theorem.

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...).
        h
            Time step > 0, scalar or (...).

        Returns
        -------
        Step
            `c` is (1 − h∇̄_sH/2)/(1 + h∇̄_sH/2): for "contact" exactly H1/H0, for "evolution" a second-order value of
            the factor by which η shrinks along a level of H. NaN where the status is not `Status.CONVERGED`.
        """
        q, p, s = check_state(state)
        h = check_h(h, q)
        x0 = join(q, p, s)

        def linearised(delta: Tensor) -> tuple[Tensor, Tensor]:
            G, J = square_jacobian(lambda d: self._equation(x0, d, h)[0], delta)
            return G, J

        with torch.no_grad():
            euler = h[..., None] * join(*FIELDS[self.field](self.H, q, p, s))
            scale = (x0.abs() + euler.abs()).amax(-1, keepdim=True)
            root = find_root(linearised, euler, scale, iterations=self.max_iterations)
        delta = root.x
        G, rate = self._equation(x0, delta, h)
        status = status_of_root(root, torch.isfinite(G.detach()).all(-1))
        if G.requires_grad:
            delta = attached(delta, root.J, G)
            rate = self._equation(x0, delta, h)[1]
        if self.throw:
            throw_failure(status, root.error)
        new, c = State(*split(x0 + delta)), (1 - h * rate / 2) / (1 + h * rate / 2)
        return Step.of(new, c, status, root.error, root.iterations)

    def _equation(self, x0: Tensor, delta: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Δ − h (B(x̄)∇̄H − H̄∂_s), whose zero is the step x1 = x0 + Δ, and ∇̄_sH."""
        x1 = x0 + delta

        def H(x: Tensor) -> Tensor:
            return self.H(*split(x))

        g = self.discrete_gradient(H, x0, x1)
        _, p, _ = split(x0 + 0.5 * delta)
        velocity = sharp_bivector(p, g)
        if self.field == "contact":
            mean = 0.5 * (H(x0) + H(x1))
            velocity = torch.cat([velocity[..., :-1], velocity[..., -1:] - mean[..., None]], -1)
        return delta - h[..., None] * velocity, g[..., -1]
