"""Checks of the Legendre transforms along rollouts: momentum matching, regularity, and set-valued dry friction.

With set-valued dry friction the step map is smooth on branches, on each of which each coordinate slides forward, slides
back or sticks. There the map is differentiable, and the identities of a forced contact map hold. A stuck coordinate
stays at q1 = q0 for all states nearby: q1 does not depend on p0, so that M = −c (∂q1/∂p0)⁻¹ is defined for the sliding
coordinates alone. The holding impulse balances the momentum, F⁻ = −D1 − c p0. Friction can supply the impulse if the
part λ of dry friction is within c h (τ + ε).

Source: `herglotz.stepping.newton.StickSlip`.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from herglotz.mechanics import (
    Forces,
    legendre_plus,
    mixed_hessian,
    momentum_jacobian,
    momentum_residual,
    partials,
)
from herglotz.mechanics.legendre import left_hessian, scaled_margin, soft_threshold, unheld_residual
from herglotz.stepping import Status, solve
from herglotz.theory import LeftHamiltonian, left_equations
from herglotz.verify.report import Check
from herglotz.verify.sampled_rollout import SampledRollout, worst
from herglotz.verify.subject import Subject

HOLDS = "dry friction holds within its bound: |λ| ≤ c h (τ + ε)"


def forces(known: Subject, w: SampledRollout) -> Forces | None:
    """Return F⁻ and F⁺ at the steps that are ok; None if the subject has no forces.

    F⁻ of a stuck coordinate includes the holding impulse, the part of D1 + c p0 + F⁻ that dry friction can supply.
    """
    if known.L_d is None:
        return None
    (q0, p0, s0), q1 = w.starts, w.ends.q
    with torch.no_grad():
        P = partials(known.L_d, q0, q1, s0, known.h)
    force = P.force
    if force is None or force.held is None:
        return force
    F = unheld_residual(P, p0)
    return replace(force, minus=force.minus - F + soft_threshold(F, force.held))


def holding(known: Subject, w: SampledRollout, bound: float) -> Check:
    """Check that dry friction can supply the impulse that a stuck coordinate needs.

    The value is the missing impulse relative to the terms that cancel. Sliding coordinates are not judged.
    """
    assert known.L_d is not None
    # Not `w.ok`: this check does not need the derivative of the map.
    done = w.status == Status.CONVERGED
    q0, p0, s0, q1 = (x[done] for x in (w.q[:, :-1], w.p[:, :-1], w.s[:, :-1], w.q[:, 1:]))
    with torch.no_grad():
        P = partials(known.L_d, q0, q1, s0, known.h)
    assert P.force is not None
    assert P.force.held is not None
    stuck = P.force.held > 0
    if not bool(stuck.any()):
        return Check.without_object("holding", HOLDS, "no coordinate stands still in these steps")
    F, size = unheld_residual(P, p0), P.D1.abs() + (P.c[..., None] * p0).abs() + P.force.held
    return Check.at_most("holding", HOLDS, worst((soft_threshold(F, P.force.held).abs() / size)[stuck]), bound)


def on_sliding(X: Tensor, slides: Tensor, rest: float) -> Tensor:
    """X (..., n, n) in the rows and columns of sliding coordinates; elsewhere `rest` on the diagonal and 0 off it."""
    both = slides[..., :, None] & slides[..., None, :]
    return torch.where(both, X, torch.diag_embed(torch.where(slides, 0.0, rest).to(X)))


# Smallest margin of det M. A kinetic term gives 1/3 (1/2 for a file); models collapsed by trap 2 give 0 or change sign.
MIN_MARGIN = 1e-3

RIGHT, LEFT = "discrete Hamilton–Jacobi equation on a fan", "left discrete Hamilton–Jacobi equation"
NO_H_PLUS = Check.without_object("hamilton_jacobi", RIGHT, "H⁺ does not exist: det D2D2 L_d = 0 at every step (E4)")
NO_H_MINUS = [
    Check.without_object(name, claim, "H⁻ does not exist: det D1D1 L⁻ = 0 at every step (E4)")
    for name, claim in (
        ("left_equations", "left Hamilton equations give back q0, p1, s0"),
        ("left_hamilton_jacobi", LEFT),
    )
]


def hamiltonians_exist(subject: Subject, w: SampledRollout) -> tuple[bool, bool]:
    """Return whether H⁺, and whether H⁻, exists at any step; True if there is no L_d or no step to judge by.

    Stepping needs neither (erratum E4): L_d = −q0·q1/h has D11 = D22 = 0 and is regular.
    """
    if subject.L_d is None or not bool(w.ok.any()):
        return True, True
    q0, _, s0 = w.starts
    with torch.no_grad():
        P = partials(subject.L_d, q0, w.ends.q, s0, subject.h, 2)
        M = mixed_hessian(P)
        margins = (scaled_margin(X, M, P.D11, P.D22) for X in (P.D22, left_hessian(P)))
    right, left = (bool((margin > MIN_MARGIN).any()) for margin in margins)
    return right, left


def momentum_matching(subject: Subject, w: SampledRollout, bound: float) -> Check:
    """Check that FL⁺ of one step is FL⁻ of the next: the residual J⁻¹R, relative to the size of positions.

    With L_d, R is evaluated on (q_{k−1}, q_k, q_{k+1}, s_{k−1}) alone. Without L_d, D1 L_d and D2 L_d come from the
    derivative of the map, by the chain rule of the one-step generating function S¹ = L_d.
    """
    statement, note = "momenta match: discrete Herglotz equation, |J⁻¹R|/|q|", ""
    both = w.ok[:, :-1] & w.ok[:, 1:]
    size = w.q.abs().amax() + (w.q[:, 1:] - w.q[:, :-1]).abs().amax()
    if subject.L_d is None:
        # The short statement leaves room for the mark of the note in a terminal.
        statement = "momenta match: |J⁻¹R|/|q|"
        note = "no L_d in the file: its derivatives are taken from those of the map"
        D1, D2, Y_p = _from_map(w)
        R = D1[:, 1:] + w.c[:, 1:, None] * D2[:, :-1]
        # ∂q1/∂p0 = −c J⁻¹.
        error = (Y_p[:, 1:] @ R[..., None])[..., 0] / w.c[:, 1:, None]
        error = error[both]
    else:
        q0, q1, q2 = (w.q[:, k : w.steps - 1 + k][both] for k in range(3))
        k = torch.arange(w.steps - 1).expand_as(both)[both]
        before, after = (subject.at(x).L_d for x in (k, k + 1))
        assert before is not None
        assert after is not None
        with torch.no_grad():
            _, p1, s1 = legendre_plus(before, q0, q1, w.s[:, :-2][both], subject.h)
            P = partials(after, q1, q2, s1, subject.h, 2)
            error = solve(momentum_jacobian(P, p1), momentum_residual(P, p1))
    return Check.at_most("momentum", statement, worst(error.abs().amax(-1) / size), bound, note)


def left_formalism(subject: Subject, w: SampledRollout, bound: float) -> Check:
    """Check that the left equations (erratum E5) give q0, p1 and s0 from (p0, q1, s1), relative to the largest.

    q0 = −D1H⁻, p1 = −D2H⁻/(1 + D3H⁻), s0 = s1 + H⁻ − p0·D1H⁻, with H⁻ from L_d by Newton solves. Steps near a fold of
    H⁻, where det D1D1L⁻ = 0, are left out.
    """
    assert subject.L_d is not None
    (q0, p0, s0), (q1, p1, s1) = w.starts, w.ends
    with torch.no_grad():
        P = partials(subject.L_d, q0, q1, s0, subject.h, 2)
        keep = scaled_margin(left_hessian(P), mixed_hessian(P), P.D11, P.D22) > MIN_MARGIN
        q0, p0, s0, q1, p1, s1 = (x[keep] for x in (q0, p0, s0, q1, p1, s1))
        H = LeftHamiltonian(subject.L_d, near=q0 - 1e-3 * (q1 - q0))
        found = left_equations(partials(H, p0, q1, s1, subject.h), p0, s1)
    folds = int((~keep).sum())
    note = f"{folds} steps left out near a fold of H⁻ (det D1D1 L⁻ = 0)" if folds else ""
    error = [worst((a - b).abs()) / _size(b) for a, b in zip(found, (q0, p1, s0), strict=True)]
    value = max(error) if all(x == x for x in error) else float("nan")
    return Check.at_most("left_equations", "left Hamilton equations give back q0, p1, s0", value, bound, note)


def _size(x: Tensor) -> float:
    return float(x.abs().max()) if x.numel() and bool((x != 0).any()) else 1.0


def regularity(subject: Subject, w: SampledRollout) -> Check:
    """Check det M ≠ 0 with a margin: the smallest singular value of M, scaled so that D11, D22 and M have size 1.

    Each coordinate is scaled by its own diagonal entries, so the margin does not depend on units. If det M has both
    signs among the samples, M is singular between the samples. M is restricted to sliding coordinates, because a step
    does not depend on the momentum of a stuck coordinate.
    """
    with torch.no_grad():
        M, sizes, slides, note = _map_hessians(w) if subject.L_d is None else _hessians(subject, w)
        slides = slides[moves := slides.any(-1)]
        M, sizes = on_sliding(M[moves], slides, 1.0), [on_sliding(x[moves], slides, 0.0) for x in sizes]
        margin = scaled_margin(M, M, *sizes).nan_to_num(0.0)
        same = _one_sign(M, slides)
    if not same:
        note = "; ".join(x for x in (note, "det M vanishes or changes sign over the samples") if x)
    value = float(margin.min()) if margin.numel() else float("nan")
    return Check.more_than("regularity", "regular: margin of det M ≠ 0", value, MIN_MARGIN, note, also=same)


def _one_sign(M: Tensor, slides: Tensor) -> bool:
    """Return whether det M has one sign, and not 0, over all samples in which the same coordinates slide."""
    finite = torch.isfinite(M).all(-1).all(-1)
    sign, sets = torch.linalg.det(M[finite]).sign(), slides[finite]
    if not len(sign) or bool((sign == 0).any()):
        return False
    which = torch.unique(sets, dim=0, return_inverse=True)[1]
    return all(bool((own == own[0]).all()) for own in (sign[which == k] for k in which.unique()))


def _hessians(subject: Subject, w: SampledRollout) -> tuple[Tensor, list[Tensor], Tensor, str]:
    """Return M, the blocks that scale M, which coordinates slide, and a note; a failed step counts as q1 = q0."""
    q0, q1 = w.q[:, :-1], w.q[:, 1:]
    q1 = torch.where(w.ok[..., None], q1, q0)
    assert subject.L_d is not None
    P = partials(subject.L_d, q0.flatten(0, 1), q1.flatten(0, 1), w.s[:, :-1].flatten(0, 1), subject.h, 2)
    note = "" if bool(w.ok.all()) else "M at q1 = q0 where the step failed"
    return mixed_hessian(P), [P.D11, P.D22], (w.slides | ~w.ok[..., None]).flatten(0, 1), note


def _map_hessians(w: SampledRollout) -> tuple[Tensor, list[Tensor], Tensor, str]:
    """Return M = −c (∂q1/∂p0)⁻¹, D22 = ∂p1/∂p0 (∂q1/∂p0)⁻¹ from the derivative of the map, what slides, and a note."""
    n = w.q.shape[-1]
    D, slides = w.derivative[w.ok], w.slides[w.ok]
    by_p = D[..., : 2 * n, n : 2 * n]
    inverse = torch.linalg.inv_ex(on_sliding(by_p[..., :n, :], slides, 1.0))[0]
    M = -w.c[w.ok][..., None, None] * inverse
    return M, [by_p[..., n:, :] @ inverse], slides, "no L_d in the file: M from the derivative of the map"


def _from_map(w: SampledRollout) -> tuple[Tensor, Tensor, Tensor]:
    """Return D1 and D2 of S¹ = L_d, by the chain rule through q1(q0, p0, s0), and ∂q1/∂p0."""
    n = w.q.shape[-1]
    D = w.derivative
    Y_q, Y_p = D[..., :n, :n], D[..., :n, n : 2 * n]
    G_q, G_p = D[..., 2 * n, :n], D[..., 2 * n, n : 2 * n]
    D2 = solve(Y_p.mT, G_p)
    D1 = G_q - (Y_q.mT @ D2[..., None])[..., 0]
    return D1, D2, Y_p
