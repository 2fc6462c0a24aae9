"""Implicit steps along the evolution field E_H, which keep H(q, p, s) exactly, and along the contact field X_H.

Evolution (thermodynamic) dynamics is what the paper's conclusions propose. With a discrete gradient a step is

    x1 = x0 + h B(x̄) ∇̄H,    B = [[0, I, 0], [−I, 0, −p], [0, pᵀ, 0]],    x = (q, p, s)

where ∇̄H·(x1 − x0) = H(x1) − H(x0). B is antisymmetric, so H(x1) = H(x0). With −h H̄ ∂_s added,
H̄ = (H0 + H1)/2, the step follows the contact field X_H, and H1 − H0 = −h H̄ ∇̄_sH exactly. Neither step is a contact
map; the step of `Stepper` is.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import jacobian, join, split
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import Hamiltonian, gradient
from herglotz.stepping.rollout import OneStepMethod
from herglotz.stepping.state import State, Step, check_h, check_state, status_of_root
from herglotz.theory.contact_manifolds import sharp_bivector
from herglotz.theory.continuous import contact_vector_field, evolution_vector_field

FIELDS = {"evolution": evolution_vector_field, "contact": contact_vector_field}


class EvolutionStepper(OneStepMethod):
    """Second-order, implicit steps of E_H or X_H by a discrete gradient.

    Parameters
    ----------
    H
        Contact Hamiltonian (q, p, s) → (...), batched.
    field
        "evolution" for E_H, which keeps H, or "contact" for X_H, along which H shrinks by the reported factor c.

    Raise InputError if `field` is unknown.

    Source: section 6 of `docs/mathematics.md`.
    """

    def __init__(self, H: Hamiltonian, *, field: str = "evolution"):
        if field not in FIELDS:
            raise InputError(f"unknown field '{field}'; choose one of {', '.join(FIELDS)}")
        self.H, self.field = H, field

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:  # noqa: ARG002
        """One step, once differentiable with respect to the state by the implicit-function theorem.

        `c` is (1 − h∇̄_sH/2)/(1 + h∇̄_sH/2). For "contact" c is exactly H1/H0; for "evolution" c is a second-order
        approximation of the factor by which η shrinks along a level of H.
        """
        q, p, s = check_state(state)
        h = check_h(h, q)
        x0 = join(q, p, s)

        def missed(delta: Tensor) -> Tensor:
            return self._equation(x0, delta, h)[0]

        with torch.no_grad():
            euler = h[..., None] * join(*FIELDS[self.field](self.H, q, p, s))
            scale = (x0.abs() + euler.abs()).amax(-1, keepdim=True)
            root = find_root(lambda delta: jacobian(missed, delta), euler, scale)
        delta = root.with_slope(missed)
        G, rate = self._equation(x0, delta, h)
        status = status_of_root(root, torch.isfinite(G.detach()).all(-1))
        new, c = State(*split(x0 + delta)), (1 - h * rate / 2) / (1 + h * rate / 2)
        return Step.of(new, c, status, root.error, root.iterations)

    def _equation(self, x0: Tensor, delta: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """The residual Δ − h (B(x̄)∇̄H − H̄∂_s), zero for the step x1 = x0 + Δ, and ∇̄_sH."""
        x1 = x0 + delta

        def H(x: Tensor) -> Tensor:
            return self.H(*split(x))

        g = midpoint_gradient(H, x0, x1)
        _, p, _ = split(x0 + 0.5 * delta)
        velocity = sharp_bivector(p, g)
        if self.field == "contact":
            mean = 0.5 * (H(x0) + H(x1))
            velocity = torch.cat([velocity[..., :-1], velocity[..., -1:] - mean[..., None]], -1)
        return delta - h[..., None] * velocity, g[..., -1]


def midpoint_gradient(
    f: Callable[[Tensor], Tensor],  # (..., m) → (...)
    x0: Tensor,  # (..., m)
    x1: Tensor,  # (..., m)
) -> Tensor:
    """∇f(x̄) + [f(x1) − f(x0) − ∇f(x̄)·Δ] Δ/|Δ|², x̄ = (x0 + x1)/2, Δ = x1 − x0; shape (..., m).

    The gradient is symmetric in x0 and x1. It depends on the units of the coordinates, since |Δ|² adds components of
    different units; its order does not.

    Source: O. Gonzalez, Time integration and discrete Hamiltonian systems, J. Nonlinear Sci. 6 (1996).
    """
    delta = x1 - x0
    _, g, _ = gradient(f, 0.5 * (x0 + x1))
    size = (delta * delta).sum(-1)
    # The bracket is O(|Δ|³). Below this |Δ| rounding exceeds the bracket, and the quotient would be noise.
    small = size <= torch.finfo(x0.dtype).eps ** (2 / 3) * (1.0 + (x0 * x0).sum(-1))
    lack = (f(x1) - f(x0) - (g * delta).sum(-1)) / torch.where(small, 1.0, size)
    return g + torch.where(small, 0.0, lack)[..., None] * delta
