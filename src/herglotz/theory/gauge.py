"""Another scale and origin of the action variable: s′ = a s + b changes neither the positions nor the factors c."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials
from herglotz.theory.left import unforced

# How many factors a each derivative carries: one for L, one less for every derivative in s.
_POWERS = {"L": 1, "D1": 1, "D2": 1, "D3": 0, "D11": 1, "D12": 1, "D22": 1, "D13": 0, "D23": 0, "D33": -1}


@dataclass(frozen=True)
class Rescaled:
    """L′(q0, q1, s′) = a L_d(q0, q1, (s′ − b)/a), the discrete Lagrangian of s′ = a s + b.

    FL⁻ and FL⁺ give p′ = a p; c, M/a and the motion of q are those of L_d. For a power of two a and b = 0 this holds
    bit for bit, short of overflow; a shift alone (a = 1) keeps p as well.

    Parameters
    ----------
    L_d
        Without forces: they are momenta, and would have to be scaled too.
    a
        Scale, not 0; a negative one turns the contact form round.
    b
        Shift, in units of s′.

    Raises
    ------
    InputError
        If a is 0 or a number is not finite.

    Source: trap 3 of `docs/mathematics.md` with f(q, s) = a s + b.
    """

    L_d: DiscreteLagrangian
    a: float = 1.0
    b: float = 0.0

    def __post_init__(self):
        if self.a == 0 or not abs(self.a) < float("inf") or not abs(self.b) < float("inf"):
            raise InputError(f"a gauge needs a finite scale a != 0 and a finite shift b, got a={self.a}, b={self.b}")

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L′, shape (...)."""
        return self.a * self.L_d(q0, q1, (s0 - self.b) / self.a, h)

    def partials(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 1) -> Partials:
        """Value and derivatives, from those of L_d."""
        P = unforced(partials(self.L_d, q0, q1, (s0 - self.b) / self.a, h, order))
        scaled = {k: v * self.a**power for k, power in _POWERS.items() if (v := getattr(P, k)) is not None}
        return Partials(**scaled)

    def forward(self, q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A state of L_d as one of L′."""
        return q, self.a * p, self.a * s + self.b

    def back(self, q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A state of L′ as one of L_d."""
        return q, p / self.a, (s - self.b) / self.a


def joined_action(
    carried: Tensor,  # (...) s where the run was started again from s = 0
    s: Tensor,  # (...) or (..., K) s′ of the new run
    sigma: Tensor,  # as s: σ of the new run, 1 at its start
) -> Tensor:
    """s_k = σ_k · carried + s′_k: the action of a run whose s was set to 0 on the way.

    Where s does not enter the motion (c is constant: conservative and linear levels) this may be done at any step, and
    q and p stay the same bit for bit. s_{k+1} = c_k s_k + A_k is affine in s, so what was left behind only fades, and
    s′ stays as small as a few of its increments, which then do not cancel however far s has run.

    Source: discrete Herglotz equations, s-line.
    """
    return sigma * (carried if s.ndim == carried.ndim else carried[..., None]) + s
