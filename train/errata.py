"""Every printed formula that is wrong, measured: its residual beside the corrected formula's.

`python train/errata.py > docs/errata.md` writes the page. Each erratum is one function, in the paper's order: e1 to e5
the contact map, its theorem, the Legendre transforms and the left formalism; e6 to e8 and e10 the discrete
Hamilton–Jacobi equations and their theorem; e9 the parachute of the application.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import Partials, mixed_hessian, momentum_minus, partials
from herglotz.mechanics.contact import jacobian
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import derivatives
from herglotz.scenes import scene
from herglotz.scenes.parachute import MAP_START, PrintedParachute
from herglotz.stepping import State, Stepper
from herglotz.theory import (
    LeftHamiltonian,
    LeftLagrangian,
    Quadratic,
    RightHamiltonian,
    commutation_defect,
    contact_product_point,
    contact_vector_field,
    evolution_vector_field,
    generating_function,
    germ,
    hamilton_jacobi_residual,
    left_equations,
    left_hamilton_jacobi_residual,
    product_potential,
    projected_flow,
    projected_step,
    prolongation,
    relatedness_defect,
    riccati_step,
    right_equations,
)

PAGE = """# Errata of the paper, measured

Source: O. Esen, C. Sardón, M. Zajac, *A Discrete Hamilton–Jacobi Theory for Contact Hamiltonian Dynamics*. Labels are
those of the equations in its LaTeX source. Every number is a residual that should be 0, by the printed formula and by
the corrected one, in float64; where a row says "A | B", A belongs to the first column. This page is written by

    python train/errata.py > docs/errata.md

and `tests/verification/test_errata.py` holds every corrected residual to 1e-10 and every printed one above 1e-3. The
last digits of the second column depend on the machine.
"""

FIGURES = """## The application, drawn

`herglotz plot parachute --out figures` draws both. The paper's own figures are not in its source; these plot what its
text says they plot.

![the printed map and its generating function](images/parachute_map.png)

Left: q_k and p_k of the printed map. The paper reads the crossing of the two lines as the opening of the parachute and
q = 0 as the landing; there is no time step in the map, and q goes on to −9e22 at k = 8. Right: D2S^k(q_k), the paper's
test of its equation, for the map as printed and with s_k² in place of s_k. Only the second is a contact map, and only
there is D2S^k(q_k) = p_k for every k drawn; as printed they agree at k = 1 alone.

![a fall with the corrected sign](images/parachute_fall.png)

λ = +0.01, the same start, the exact discrete Lagrangian at h = 0.2 s: height and velocity to the ground, and D2S^k(q_k)
on the momentum of the stepper.
"""

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


def e1() -> Erratum:
    s, h = scene("damped_oscillator"), 0.1
    x0 = oscillator_start()
    x1 = s.flow(*x0, h)
    L_d: Callable[..., Tensor] = lambda q0, q1, s0: s.L_d(q0, q1, s0, tensor(h)[0])  # noqa: E731
    W = product_potential(L_d)
    base, momenta, z = contact_product_point(x0, x1, partials(s.L_d, x0.q, x1[0], x0.s, h).c)
    found = []
    for sign in (-1.0, 1.0):
        _, slope, value = prolongation(lambda b, sign=sign: sign * W(b), base)
        found.append(size(slope - momenta, value - z))
    return Erratum(
        "E1",
        "unnumbered, before `Leg-trf`",
        "W = ŝ + S generates the contact map",
        "W = −(ŝ + S): the last Darboux coordinate is z = −s",
        (Row(f"j¹W − the graph of one step; {OSCILLATOR}", *found),),
    )


def e2() -> Erratum:
    def momentum(q: Tensor, p: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        return p[..., 0] + 0.0 * s

    def drag(q: Tensor, p: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        return 0.5 * p[..., 0] ** 2 + gamma * s

    def related(H: Callable[..., Tensor], F: Callable[[Tensor], Tensor], field: Callable[..., tuple]) -> float:
        return size(relatedness_defect(lambda q, p, s: field(H, q, p, s), F, tensor(0.7)))

    gamma = 0.4
    F, G = (lambda q: q[..., 0]), (lambda q: -0.5 * gamma * q[..., 0] ** 2)
    return Erratum(
        "E2",
        "`HJT-Con-1-eq-2--` (Theorem 1)",
        "X_H is γ-related to its projection if and only if d(H∘γ) = 0",
        "if and only if H∘γ = 0; d(H∘γ) = 0 is the condition for the evolution field E_H = X_H + H ∂_s",
        (
            Row(
                "H = p, F = q, where d(H∘γ) = 0: defect of X_H | of E_H",
                related(momentum, F, contact_vector_field),
                related(momentum, F, evolution_vector_field),
            ),
            Row(
                "H = p²/2 + 0.4 s: defect of X_H on F = 2.5 − 0.2 q² (H∘γ = 1) | on F = −0.2 q² (H∘γ = 0)",
                related(drag, lambda q: G(q) + 1 / gamma, contact_vector_field),
                related(drag, G, contact_vector_field),
            ),
        ),
    )


def e3() -> Erratum:
    rows = []
    for name, x, h, words in (
        ("parachute", parachute_start(), 0.1, PARACHUTE),
        ("nonlinear_action", *two_dof(), TWO_DOF),
    ):
        L_d = scene(name).L_d
        step = Stepper(L_d).step(x, h)
        q1, p1, s1 = step.state
        found = [size(partials(L_d, x.q, q1, s, h).D2 - p1) for s in (s1, x.s)]
        rows.append(Row(f"D2 L_d − p_k; {words}", *found))
    return Erratum(
        "E3",
        "unnumbered, after `disccontleg`; `reg-cond`",
        "p⁺_{k−1,k} = D2 L_d(q_{k−1}, q_k, s_k)",
        "p⁺_{k−1,k} = D2 L_d(q_{k−1}, q_k, s_{k−1})",
        tuple(rows),
    )


def e4() -> Erratum:
    x, h = two_dof()
    real = scene("nonlinear_action").L_d
    one, s = (tensor(0.3), tensor(0.9)), tensor(0.2)[0]
    cases = (
        ("L_d = (q0² + q1²)/2: det D2D2 = 1, M = 0", _squares, *one, s),
        ("L_d = q0 q1: det D2D2 = 0, M = 1", _product, *one, s),
        (TWO_DOF, real, x.q, Stepper(real).step(x, h).state.q, x.s),
    )
    rows = []
    for words, L_d, q0, q1, s0 in cases:
        slope = jacobian(lambda y, L=L_d, q=q0, s=s0: momentum_minus(partials(L, q, y, s, h)), q1)[1]
        P = partials(L_d, q0, q1, s0, h, order=2)
        found = [size(slope + X / P.c) for X in (P.D22, mixed_hessian(P))]
        rows.append(Row(f"∂p_k/∂q_{{k+1}} + X/c, X = D2D2 L_d | M; {words}", *found))
    return Erratum(
        "E4",
        "`reg-cond`",
        "L_d is regular, and FL⁻, FL⁺ invertible, where det D2D2 L_d ≠ 0",
        "where c ≠ 0 and det M ≠ 0, M = D1D2 L_d − D1 L_d ⊗ D3D2 L_d / c; det D2D2 L_d ≠ 0 is what H⁺ needs",
        tuple(rows),
    )


def _squares(q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    return 0.5 * (q0 * q0 + q1 * q1).sum(-1) + 0.0 * s0 * h


def _product(q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    return (q0 * q1).sum(-1) + 0.0 * s0 * h


def e5() -> Erratum:
    rows = []
    for name, x, h, words in (
        ("damped_oscillator", oscillator_start(), 0.1, OSCILLATOR),
        ("nonlinear_action", *two_dof(), TWO_DOF),
        ("nonlinear_action", two_dof()[0], 0.3, TWO_DOF.replace("h = 0.2", "h = 0.3")),
    ):
        L_d = scene(name).L_d
        q1, p1, s1 = Stepper(L_d).step(x, h).state

        def residual(P: Partials, p: Tensor, x=x, p1=p1, s1=s1) -> float:
            s0 = s1 - (x.p * P.D1).sum(-1) + P.L
            return size(-P.D1 - x.q, p - p1, s0 - x.s)

        H = partials(LeftHamiltonian(L_d, x.q), x.p, q1, s1, h)
        corrected = size(*(a - b for a, b in zip(left_equations(H, x.p, s1), (x.q, p1, x.s), strict=True)))
        wrong = printed_left(L_d, x.p, q1, s1, h, x.q)
        rows += [
            Row(f"(q_k, p_{{k+1}}, s_k) as printed; {words}", residual(wrong, wrong.D2), corrected),
            Row("the same with the sign of p_{k+1} changed", residual(wrong, -wrong.D2), corrected),
            Row("right H⁻, p_{k+1} = D2H⁻ as printed", residual(H, H.D2), corrected),
            Row("right H⁻, p_{k+1} = −D2H⁻: the sign alone", residual(H, -H.D2), corrected),
        ]
    return Erratum(
        "E5",
        "`ldh`, `L-H2`, `disconteqneg`",
        "H⁻ = −p_k·q_k − L_d(q_k, q_{k+1}, s_{k+1}) and p_{k+1} = D2H⁻",
        "H⁻ = −p_k·q_k − L⁻ with the left Lagrangian L⁻(q_k, q_{k+1}, s_{k+1}) = s_{k+1} − s_k, and "
        "p_{k+1} = −D2H⁻/(1 + D3H⁻)",
        tuple(rows),
    )


def solutions(k: int, h: float = 0.1):
    """S^k and its derivatives for a damped oscillator from `OSCILLATOR`."""
    stepper, x = Stepper(scene("damped_oscillator").L_d), oscillator_start()

    def flow(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return stepper.rollout(q, p, s, h=h, steps=k).final

    return generating_function(flow, *x)


def e6() -> Erratum:
    s, h, k = scene("damped_oscillator"), 0.1, 3
    S0, S1 = solutions(k), solutions(k + 1)
    H_minus = LeftHamiltonian(s.L_d)
    swapped = H_minus(S1.q, S0.D2, S1.s, h)
    inside = printed_left(s.L_d, S0.D2, S1.q, S1.s, h, S0.q).L
    right = H_minus(S0.D2, S1.q, S1.s, h)
    found = [size(left_hamilton_jacobi_residual(S1.s, S0.s, S0.D2, S0.q, H)) for H in (swapped, inside, right)]
    return Erratum(
        "E6",
        "`firstdiscreteleft`",
        "… + H⁻(q_{k+1}, dS^k(q_k), S^{k+1}(q_{k+1})) = 0: arguments exchanged, and H⁻ that of `ldh`",
        "S^{k+1}(q_{k+1}) − S^k(q_k) + dS^k(q_k)·q_k + H⁻(dS^k(q_k), q_{k+1}, S^{k+1}(q_{k+1})) = 0 with H⁻ of E5",
        (
            Row(f"residual at k = {k} in the printed order, right H⁻; {OSCILLATOR}", found[0], found[2]),
            Row("the same in the right order with the printed H⁻", found[1], found[2]),
        ),
    )


def e7() -> Erratum:
    s, h = scene("damped_oscillator"), 0.1
    H_plus = RightHamiltonian(s.L_d)
    P = partials(s.L_d, tensor(0.0), tensor(0.0), tensor(0.0)[0], h, order=2)
    S0 = Quadratic(tensor(1.0)[:, None], tensor(0.5), tensor(0.25)[0])
    S1 = riccati_step(P, S0)
    q0 = tensor(0.8)

    def residual(q1: Tensor) -> Tensor:
        a, b = germ(S0, q0), germ(S1, q1)
        return hamilton_jacobi_residual(b.S, a.S, b.dS, q1, H_plus(q0, b.dS, a.S, h))

    q1 = s.flow(q0, germ(S0, q0).dS, germ(S0, q0).S, h)[0]
    on, off = size(residual(q1)), [size(residual(q1 + d)) for d in (0.1, 0.2)]
    pair = q1 + 0.1
    slope = jacobian(lambda y: residual(y)[..., None], pair)[1][..., 0, :]
    at = germ(S1, pair)
    D2H = partials(H_plus, q0, at.dS, germ(S0, q0).S, h).D2
    predicted = -(at.d2S @ (pair - D2H)[..., None])[..., 0]
    return Erratum(
        "E7",
        "`firstdiscrete`, `firstdiscrete-1`, `condi`",
        "the discrete Hamilton–Jacobi equation, without saying for which pairs (q_k, q_{k+1})",
        "an identity in q_k with q_{k+1} = Φ̃^γ(q_k); off the flow it fails with the square of the distance. Its slope "
        "there is −d²S^{k+1}(q_{k+1} − D2H⁺), so for all pairs it would force d²S^{k+1} = 0: S affine. Well posed: "
        "S^{k+1}(y) = ext_x [S^k(x) + L_d(x, y, S^k(x))]",
        (
            Row("residual at q_{k+1} 0.1 off the flow | on it; damped oscillator, quadratic S^k", off[0], on),
            Row("the same 0.2 off | on it: four times as large", off[1], on),
            Row("its slope 0.1 off the flow | the slope less the formula beside", size(slope), size(slope - predicted)),
        ),
    )


def e8() -> Erratum:
    s, h, k = scene("damped_oscillator"), 0.5, 3
    x0 = oscillator_start()
    x1 = State(*s.flow(*x0, h))
    P = partials(s.L_d, tensor(0.0), tensor(0.0), tensor(0.0)[0], h, order=2)
    S0 = Quadratic(tensor(1.0)[:, None], tensor(0.5), tensor(0.25)[0])
    at = germ(S0, x0.q)
    q1, p1, _ = s.flow(x0.q, at.dS, at.S, h)
    section = [size(germ(S, q1).dS - p1) for S in (S0, riccati_step(P, S0))]
    left = partials(LeftLagrangian(s.L_d), x0.q, x1.q, x1.s, h)
    D3 = [
        size(partials(H, a, b, c, h).D3 + left.D3)
        for H, a, b, c in ((RightHamiltonian(s.L_d), x0.q, x1.p, x0.s), (LeftHamiltonian(s.L_d), x0.p, x1.q, x1.s))
    ]
    sigma = torch.exp(tensor(-0.2 * h * (k + 1)))
    step3 = [size(1 + solutions(j, h).D3 - sigma) for j in (k, k + 1)]
    H, F = scene("damped_pendulum").hamiltonian, (lambda q: torch.sin(q[..., 0]))
    q, p, S = prolongation(F, tensor(0.7))
    D = derivatives(H, q, p, S)
    s_dot = contact_vector_field(H, q, p, S)[2]
    proof = [size((p * D_).sum(-1) - D.L - s_dot) for D_ in (D.D1, D.D2)]
    return Erratum(
        "E8",
        "`gamma-a`, `L-H2`, Step 3 before `pre-HJ`, `Proof-2-`, `Proof-1-`, diagram before `commit`; matching of "
        "momenta before `reg-cond`; Φ̃^γ before `commit`, `condi`",
        "γ^{k+1} with dS^k; D3H⁺ in the left equations; D3S^k in the second identity of Step 3; F_q·H_q as the last "
        "component of X_H∘γ and Tγ∘X^γ; ρ: T*Q×R → Q×R; p_k = p⁻_{k,k+1,k+1}; ds_d^{k+1}",
        "dS^{k+1}; D3H⁻; D3S^{k+1}; F_q·H_p; and three symbols, with nothing to measure: ρ: T*Q×R → Q, "
        "p_k = p⁻_{k,k+1,k}, dS_d^{k+1}",
        (
            Row(
                f"dS(q_{{k+1}}) − p_{{k+1}} with S^k | S^{{k+1}}; quadratic S^k, damped oscillator, γ = 0.2, h = {h}",
                *section,
            ),
            Row("D3H⁺ | D3H⁻, plus D3L⁻", *D3),
            Row(f"1 + D3S^k | 1 + D3S^{{k+1}}, less σ_{{k+1}}, k = {k}", *step3),
            Row("F_q·H_q − H | F_q·H_p − H, less ṡ; damped pendulum, F = sin q, q = 0.7", *proof),
        ),
    )


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
    H_plus = printed.H_plus, RightHamiltonian(right.L_d, x1.q)
    q1 = [right_equations(partials(H, x.q, x1.p, x.s, h), x1.p, x.s)[0] - x1.q for H in H_plus]
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
        "H = (p − 2λs)²/2m + V with λ = +0.01; H⁺ = p_{k+1}q_k + h H + O(h²); − 2λ²s_k²/m",
        (
            Row(f"acceleration at rest at q = 100 (printed: {up:+.2f}, upward), plus g", *(size(a + g) for a in rest)),
            Row(f"D2H⁺ − q_{{k+1}} of the fall; {PARACHUTE}", *(size(d) for d in q1)),
            Row(f"s_2 − (s_1 + p_2 q_2 − H⁺) of the printed map; {both}", *actions),
            Row("the same: (D2S³ − p_3)/p_3, so the paper's second figure is not its first", *slopes),
        ),
    )


def e10() -> Erratum:
    c, h, kappa = 0.93, 0.1, 0.8

    def L_d(q0: Tensor, q1: Tensor, s0: Tensor, _h: Tensor) -> Tensor:
        a, b = q0[..., 0], q1[..., 0]
        return (c - 1) * s0 + 0.45 * a**2 - 1.4 * a * b + 0.55 * b**2

    def flow(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        q, p, s = Stepper(L_d).step(State(q, p, s), h).state
        return q, p, s

    zero = tensor(0.0)
    P = partials(L_d, zero, zero, zero[0], h, order=2)
    S0 = Quadratic(tensor(0.7)[:, None], tensor(-0.4), tensor(0.2)[0])
    S1 = riccati_step(P, S0)
    D22 = float(P.D22)
    wrong = Quadratic(S1.alpha - D22, S1.beta + D22 * kappa, S1.delta - 0.5 * D22 * kappa**2)
    q0 = torch.linspace(-1.5, 2.0, 15, dtype=torch.float64)[:, None]
    H_plus, H_minus = RightHamiltonian(L_d, q0), LeftHamiltonian(L_d, q0)

    def residuals(S: Quadratic, q1: Tensor) -> tuple[float, float]:
        a, b = germ(S0, q0), germ(S, q1)
        right = hamilton_jacobi_residual(b.S, a.S, b.dS, q1, H_plus(q0, b.dS, a.S, h))
        return size(right), size(left_hamilton_jacobi_residual(b.S, a.S, a.dS, q0, H_minus(a.dS, q1, b.S, h)))

    along = projected_flow(flow, S0, q0)
    (right_wrong, left_wrong), (_, left) = residuals(wrong, along), residuals(S1, along)
    # On the flow the equation does not depend on δ.
    assert right_wrong < 1e-13
    own = [residuals(S, projected_step(H_plus, S0, S, q0, h, along))[0] for S in (wrong, S1)]
    commutes = [size(commutation_defect(flow, S0, S, q0)) for S in (wrong, S1)]
    setting = "quadratic L_d, c = 0.93, δ = −½D22 (q − 0.8)², q_k from −1.5 to 2"
    return Erratum(
        "E10",
        "`gHJ-discrete` (Theorem 3)",
        "S solves `firstdiscrete-1` if and only if Φ̃∘γ^k = γ^{k+1}∘Φ̃^γ, without saying at which q_{k+1}",
        "the diagram implies the equation; the converse needs q_{k+1} = D2H⁺(q_k, dS^{k+1}(q_{k+1}), S^k(q_k)), or the "
        "left equation too. Along the flow the right residual of S^{k+1} + δ is δ + ½dδ·(D22 L_d)⁻¹dδ, which is 0 for "
        "δ = −½(q − κ)·D22 (q − κ)",
        (
            Row(f"defect of the diagram: S^{{k+1}} + δ | S^{{k+1}}, both of right residual 0; {setting}", *commutes),
            Row("left residual: S^{k+1} + δ | S^{k+1}", left_wrong, left),
            Row("right residual at q_{k+1} by D2H⁺: S^{k+1} + δ | S^{k+1}", *own),
        ),
    )


def markdown(errata: list[Erratum]) -> str:
    parts = [PAGE]
    for e in errata:
        where = e.label[0].upper() + e.label[1:]
        parts.append(f"## {e.number}\n\n{where}.\n\n*Printed:* {e.printed}.\n\n*Right:* {e.right}.\n")
        rows = [f"| {r.setting.replace('|', chr(92) + '|')} | {r.printed:.3g} | {r.corrected:.1e} |" for r in e.rows]
        parts.append("\n".join(["| measured | printed | corrected |", "|---|---|---|", *rows]) + "\n")
    return "\n".join([*parts, FIGURES])


ERRATA: tuple[Callable[[], Erratum], ...] = (e1, e2, e3, e4, e5, e6, e7, e8, e9, e10)

if __name__ == "__main__":
    torch.set_num_threads(1)
    print(markdown([make() for make in ERRATA]), end="")
