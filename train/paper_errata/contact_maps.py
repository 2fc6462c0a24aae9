"""E1 to E5: the contact map, its theorem, the Legendre transforms and the left formalism."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from herglotz.mechanics import Partials, mixed_hessian, momentum_minus, partials
from herglotz.mechanics.contact import jacobian
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.theory import (
    LeftHamiltonian,
    contact_product_point,
    contact_vector_field,
    evolution_vector_field,
    left_equations,
    product_potential,
    prolongation,
    relatedness_defect,
)
from paper_errata.erratum import (
    OSCILLATOR,
    PARACHUTE,
    TWO_DOF,
    Erratum,
    Row,
    oscillator_start,
    parachute_start,
    printed_left,
    size,
    tensor,
    two_dof,
)


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

        H = LeftHamiltonian(L_d, x.q).partials(x.p, q1, s1, h)
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
