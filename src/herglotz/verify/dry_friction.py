"""Set-valued dry friction: the step map is smooth on branches, and a stuck coordinate has its own identity.

On a branch each coordinate slides forward, slides back or sticks. There the map is differentiable, and the identities
of a forced contact map hold. A stuck coordinate stays at q1 = q0 for all states nearby: q1 does not depend on p0, so
that M = −c (∂q1/∂p0)⁻¹ is defined for the sliding coordinates alone. The holding impulse balances the momentum, F⁻ =
−D1 − c p0. Friction can supply the impulse if the part λ of dry friction is within c h (τ + ε).

Source: `herglotz.stepping.stick_slip`.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from herglotz.mechanics import Forces, partials
from herglotz.mechanics.legendre import soft_threshold, unheld_residual
from herglotz.stepping import Status
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
