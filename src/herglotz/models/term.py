"""Terms by name: one file and one line in `TERMS`, and a model with the term steps, fits, verifies and exports."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from herglotz.errors import InputError
from herglotz.mechanics import Forces
from herglotz.models.jet import Jet, coordinates


class Term(nn.Module):
    """A part V(q) of the potential, a force −∂R/∂v of a dissipation function R(v) (Rayleigh), or both.

    Write `potential` or `dissipation` in jets, which carry their derivatives along. The force acts in halves,
    F⁻ = c (h/2) f and F⁺ = (h/2) f at v = Δ/h, and needs the forced level. Parameters are float64 and start where the
    term vanishes, so that a new model equals its baseline. A force that is not `linear` in v makes the step iterate.
    `spread` is the σ of the prior of every parameter about its start; None: no prior.

    Source: trap 4 of `docs/mathematics.md`.

    Parameters
    ----------
    config
        The `ModelConfig` of the model that the term joins.
    """

    linear = True
    spread: float | None = None

    def __init__(self, config: Any):
        super().__init__()
        self.dof = config.dof

    @classmethod
    def has_force(cls) -> bool:
        """Return whether the term has a force."""
        return cls.dissipation is not Term.dissipation or cls.force is not Term.force

    def potential(self, q: Jet) -> Jet | None:  # noqa: ARG002
        """V as a function of the n coordinates; None for a term without a potential."""
        return None

    def dissipation(self, v: Jet) -> Jet | None:  # noqa: ARG002
        """R as a function of the n velocities; None for a term without a dissipation function."""
        return None

    def force(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return f = −∂R/∂v, (..., n), and ∂f/∂v, (..., n, n)."""
        R = self.dissipation(coordinates(v, 2))
        if R is None:
            raise InputError(f"{type(self).__name__}.dissipation returned None; return a jet, or leave the method out")
        return -R.gradient.movedim(0, -1), -R.hessian().movedim((0, 1), (-2, -1))


# A term's name in `ModelConfig(terms=...)`, and its class.
TERMS: dict[str, type[Term]] = {}


def check_terms(config: Any) -> None:
    """Raise `InputError` for a term of a `ModelConfig` that is not registered, or that the level cannot have."""
    for name in config.terms:
        if name not in TERMS:
            known = ", ".join(TERMS) or "none"
            raise InputError(f"unknown term '{name}' (known: {known}); add its class to herglotz.models.TERMS first")
        if TERMS[name].has_force() and config.level != "forced":
            raise InputError(f"the term '{name}' has a force; set level='forced', not '{config.level}'")
    if config.terms and (config.order == 4 or not config.baseline):
        raise InputError("terms need order 2 and a baseline; set order=2 and baseline=True, or leave terms out")


def with_force(own: Forces, f: Tensor, slope: Tensor, c: Tensor, h: Tensor, by_q: Tensor | float = 0.0) -> Forces:
    """Return `own` plus a force f (..., n) in halves, F⁻ = c (h/2) f and F⁺ = (h/2) f, with derivatives if `own` has.

    `slope` is ∂f/∂v at v = Δ/h, and `by_q` ∂f/∂q̄ at the midpoint, (..., n, n) each.
    """
    minus, plus = own.minus + (c * h / 2)[..., None] * f, own.plus + (h / 2)[..., None] * f
    if own.minus_2 is None:
        return replace(own, minus=minus, plus=plus)
    along, across, c_ = slope / 2, by_q * (h / 4)[..., None, None], c[..., None, None]
    return replace(
        own, minus=minus, plus=plus, minus_1=own.minus_1 + c_ * (across - along),
        minus_2=own.minus_2 + c_ * (across + along), plus_1=own.plus_1 + (across - along),
        plus_2=own.plus_2 + (across + along),
    )  # fmt: skip


def value_and_slope(terms: tuple[Term, ...], q: Tensor) -> tuple[Tensor, Tensor]:
    """V (...) and V′ (..., n), summed over the terms."""
    V, slope = q.new_zeros(q.shape[:-1]), torch.zeros_like(q)
    for term in terms:
        if (jet := term.potential(coordinates(q, 1))) is not None:
            V, slope = V + jet.value, slope + jet.gradient.movedim(0, -1)
    return V, slope
