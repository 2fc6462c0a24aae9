"""E9: the parachute of the application."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from herglotz.mechanics import partials
from herglotz.mechanics.partials import derivatives
from herglotz.scenes import scene
from herglotz.scenes.parachute import MAP_START, PrintedParachute
from herglotz.stepping import State
from herglotz.theory import contact_vector_field, generating_function, right_equations
from paper_errata.erratum import PARACHUTE, Erratum, Row, parachute_start, size, tensor


def e9() -> Erratum:
    printed, right = PrintedParachute(), scene("parachute")

    def wrong_sign(q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        return (p[..., 0] + 2 * printed.lam * s) ** 2 / (2 * printed.m) + printed.potential(q)

    def acceleration(H: Callable[..., Tensor], p: Tensor) -> Tensor:
        """v̇ along X_H for v = H_p."""
        x = tensor(100.0), p, tensor(1.0)[0]
        P = derivatives(H, *x, order=2)
        q_dot, p_dot, s_dot = contact_vector_field(H, *x)
        return P.D12 @ q_dot + P.D22 @ p_dot + P.D23 * s_dot

    g = printed.g
    rest = [acceleration(wrong_sign, tensor(0.02)), acceleration(right.hamiltonian, tensor(0.02))]
    up = float(rest[0])
    x, h = parachute_start(), 0.1
    x1 = State(*right.flow(*x, h))
    assert right.H_plus is not None
    q1 = [right_equations(partials(H, x.q, x1.p, x.s, h), x1.p, x.s)[0] - x1.q for H in (printed.H_plus, right.H_plus)]
    q, p, s = (tensor(v) for v in MAP_START)
    start = State(q, p, s[0])
    actions, slopes, seconds = [], [], []
    for squared in (False, True):
        step = PrintedParachute(squared=squared)
        one = step(*start)
        two = step(*one)
        exact = one[2] + (two[1] * two[0]).sum(-1) - step.H_plus(one[0], two[1], one[2])
        actions.append(size(two[2] - exact))
        seconds.append(float(two[2]))
        G = generating_function(lambda q, p, s, step=step: step(*step(*step(q, p, s))), *start)
        slopes.append(size((G.D2 - G.p) / G.p))
    both = f"s_2 = {seconds[0]:.2f} as printed | {seconds[1]:.2f} with s²"
    return Erratum(
        "E9",
        "`eq:parachute_hamiltoniam2` and the map after it",
        "H = (p + 2λs)²/2m + V with λ = −0.01; H⁺ = H(q_k, p_{k+1}, s_k); s_{k+1} = … − 2λ²s_k/m …",
        "H = (p − 2λs)²/2m + V with λ = +0.01; H⁺ = p_{k+1}q_k + h H + O(h²), in closed form in `ExactParachute`; "
        "− 2λ²s_k²/m",
        (
            Row(f"acceleration at rest at q = 100 (printed: {up:+.2f}, upward), plus g", *(size(a + g) for a in rest)),
            Row(f"D2H⁺ − q_{{k+1}} of the fall; {PARACHUTE}", *(size(d) for d in q1)),
            Row(f"s_2 − (s_1 + p_2 q_2 − H⁺) of the printed map; {both}", *actions),
            Row("the same: (D2S³ − p_3)/p_3, so the paper's second figure is not its first", *slopes),
        ),
    )
