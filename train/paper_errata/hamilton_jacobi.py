"""E6 to E8 and E10: the discrete Hamilton–Jacobi equations, their theorem, and the misprints around them."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics import partials
from herglotz.mechanics.contact import jacobian
from herglotz.mechanics.partials import derivatives
from herglotz.scenes import scene
from herglotz.stepping import State, Stepper
from herglotz.theory import (
    LeftHamiltonian,
    LeftLagrangian,
    Quadratic,
    RightHamiltonian,
    commutation_defect,
    contact_vector_field,
    generating_function,
    germ,
    hamilton_jacobi_residual,
    left_hamilton_jacobi_residual,
    projected_flow,
    projected_step,
    prolongation,
    riccati_step,
)
from paper_errata.erratum import OSCILLATOR, Erratum, Row, oscillator_start, printed_left, size, tensor


def solutions(k: int, h: float = 0.1):
    """S^k and its derivatives for a damped oscillator from `OSCILLATOR`."""
    stepper, x = Stepper(scene("damped_oscillator").L_d), oscillator_start()

    def flow(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return stepper.rollout(q, p, s, h=h, steps=k).final

    return generating_function(flow, *x)


def e6() -> Erratum:
    s, h, k = scene("damped_oscillator"), 0.1, 3
    S0, S1 = solutions(k), solutions(k + 1)
    assert s.H_minus is not None
    swapped = s.H_minus(S1.q, S0.D2, S1.s, h)
    inside = printed_left(s.L_d, S0.D2, S1.q, S1.s, h, S0.q).L
    right = s.H_minus(S0.D2, S1.q, S1.s, h)
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
    assert s.H_plus is not None
    H_plus = s.H_plus
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
    assert s.H_plus is not None
    assert s.H_minus is not None
    P = partials(s.L_d, tensor(0.0), tensor(0.0), tensor(0.0)[0], h, order=2)
    S0 = Quadratic(tensor(1.0)[:, None], tensor(0.5), tensor(0.25)[0])
    at = germ(S0, x0.q)
    q1, p1, _ = s.flow(x0.q, at.dS, at.S, h)
    section = [size(germ(S, q1).dS - p1) for S in (S0, riccati_step(P, S0))]
    left = partials(LeftLagrangian(s.L_d), x0.q, x1.q, x1.s, h)
    D3 = [
        size(partials(H, a, b, c, h).D3 + left.D3)
        for H, a, b, c in ((s.H_plus, x0.q, x1.p, x0.s), (s.H_minus, x0.p, x1.q, x1.s))
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
