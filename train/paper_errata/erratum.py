"""What an erratum is, and the motions that several are measured on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import Partials, partials
from herglotz.mechanics.newton import find_root
from herglotz.stepping import State

OSCILLATOR = "damped oscillator m = Ω = 1, γ = 0.2, h = 0.1, start (1, 0.5, 0.3)"
PARACHUTE = "parachute m = 1, g = 10, λ = 0.01, h = 0.1, start (100, 1, 1)"
TWO_DOF = "2 degrees of freedom, nonlinear in s, h = 0.2, start (0.3, −0.5; 0.7, 0.2; 0.4)"


@dataclass(frozen=True)
class Row:
    """One measurement: the same quantity by the printed and by the corrected formula; both should be 0."""

    setting: str
    printed: float
    corrected: float


@dataclass(frozen=True)
class Erratum:
    """The printed formula, the corrected one, and the residuals of both; `label` is that of the paper's source."""

    number: str
    label: str
    printed: str
    right: str
    rows: tuple[Row, ...]


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def size(*residuals: Tensor) -> float:
    return max(float(x.abs().max()) for x in residuals)


def oscillator_start() -> State:
    return State(tensor(1.0), tensor(0.5), tensor(0.3)[0])


def parachute_start() -> State:
    return State(tensor(100.0), tensor(1.0), tensor(1.0)[0])


def two_dof() -> tuple[State, float]:
    return State(tensor(0.3, -0.5), tensor(0.7, 0.2), tensor(0.4)[0]), 0.2


def printed_left(L_d: Callable[..., Tensor], p0: Tensor, q1: Tensor, s1: Tensor, h: float, near: Tensor) -> Partials:
    """H⁻ as printed, −p0·q0 − L_d(q0, q1, s1) with D1 L_d(q0, q1, s1) = −p0, and its true derivatives."""

    def equations(q0: Tensor) -> tuple[Tensor, Tensor]:
        P = partials(L_d, q0, q1, s1, h, order=2)
        return P.D1 + p0, P.D11

    q0 = find_root(equations, near).solved
    P = partials(L_d, q0, q1, s1, h)
    return Partials(-(p0 * q0).sum(-1) - P.L, -q0, -P.D2, -P.D3)
