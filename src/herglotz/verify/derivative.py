"""Check of the derivative DΦ̃ that autograd reports, by finite differences of the map.

An L_d can hide a dependence from autograd (a detached potential, a table read with `numpy.interp`). p, c and DΦ̃ come
from the same autograd and satisfy every identity; only differences of the map show the dependence.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.export.differences import WEIGHTS, central_differences, stepped
from herglotz.verify.report import Check
from herglotz.verify.sampled_rollout import SampledRollout, rounded, worst
from herglotz.verify.subject import Subject

# Offset of the differences of order 8, in units of each component's spread over the samples. float64: truncation and
# rounding are of equal size there; float32: rounding decides.
OFFSET = {torch.float64: 0.01, torch.float32: 0.1}
# Sound maps leave 5e-14 to 9e-12 in float64 (every scene, 32 samples). A potential that autograd does not see leaves
# 0.1 at h = 0.1 and 0.001 at h = 0.001.
AGREES = {torch.float64: 1e-6, torch.float32: 1e-2}
# Factors of the offset for the narrower differences that follow where the wide ones do not agree.
NARROW = (0.1, 1e-3)
# Where narrow differences decide, the wide ones must agree within this: only a wide stencil meets a jump.
COARSE = 0.01
# A component is constant if its spread is below this multiple of its rounding.
MIN_SPREAD_IN_ROUNDINGS = 1e4
# All steps of the wide stencils: 170 points of one coordinate, 48 of ten, drawn from all rollouts.
MAX_STEPS = 4096


def derivative(subject: Subject, w: SampledRollout) -> Check:
    """Compare DΦ̃ at steps of all rollouts with central differences, in units of the components' spreads.

    The error is the largest |ΔDΦ̃_ij| spread_j over the largest |DΦ̃_ij| spread_j of row i. A jump shows only if a
    stencil meets the jump; each stencil covers 8 % of a spread, so many points are compared. Where the map bends within
    8 %, near a wall or a collision, narrower differences decide, and the wide ones must agree within `COARSE`.

    Set-valued friction has kinks, at which no derivative exists. A sample is judged if its stencil, wide or narrow,
    stays on one branch of the map. Stribeck's curve bends sharply, so narrow differences alone decide then. The kinks
    of other forces are unknown: the median of the samples is judged.
    """
    x = torch.cat([w.q[:, :-1], w.p[:, :-1], w.s[:, :-1, None]], -1)[w.ok]
    count, make = MAX_STEPS // (2 * len(WEIGHTS) * x.shape[-1]), torch.Generator().manual_seed(0)
    spread, keep = _spread(x), torch.randperm(len(x), generator=make)[: max(4, count)].to(x.device)
    x, D = x[keep], w.derivative[w.ok][keep]
    wide = _errors(subject, x, D, spread, OFFSET[x.dtype])
    bound = max(AGREES[x.dtype], rounded(0.0, w) / OFFSET[x.dtype])
    errors, bent = wide.clone(), ~(wide <= bound)
    if bool(bent.any()):
        widths = (share * OFFSET[x.dtype] for share in NARROW)
        for narrow in (_errors(subject, x[bent], D[bent], spread, width) for width in widths):
            errors[bent] = torch.fmin(errors[bent], narrow)
        if not subject.sticks:
            errors[bent] = torch.maximum(errors[bent], bound / COARSE * wide[bent])
    found = errors[~errors.isnan()]
    left_out = len(x) - len(found)
    beside = "a step beside them failed" + (", or changes between sliding and standing still" if subject.sticks else "")
    note = f"{left_out} of {len(x)} samples left out: {beside}" if left_out else ""
    value, how = worst(found), ": central differences"
    if (subject.forced or _has_forces(subject)) and not subject.sticks:
        value, how = float(found.median()) if len(found) else float("nan"), " (median of differences)"
    claim = f"{subject.derivative_of} DΦ̃ is the derivative{how}"
    return Check.at_most("derivative", claim, value, bound, note)


def _errors(subject: Subject, x: Tensor, D: Tensor, spread: Tensor, offset: float) -> Tensor:
    """The largest error of each sample, (B), over the largest entry of its row; NaN where no differences exist."""
    with torch.no_grad():
        found = central_differences(lambda y: stepped(subject.step, y, subject.h), x, offset * spread, subject.sticks)
    scaled, error = D.abs() * spread, (D - found).abs() * spread
    error = error / scaled.amax((0, -1))[:, None] if len(scaled) else error
    return error.flatten(1).amax(-1)


def _spread(x: Tensor) -> Tensor:
    """The standard deviation of each component; its largest size, or 1, if the component is constant."""
    if not len(x):
        return torch.ones_like(x[0:1].sum(0))
    spread, floor = x.std(0, correction=0), x.abs().amax(0)
    spread = torch.where(spread > MIN_SPREAD_IN_ROUNDINGS * torch.finfo(x.dtype).eps * floor, spread, floor)
    return torch.where(spread > 0, spread, 1.0)


def _has_forces(subject: Subject) -> bool:
    forces = getattr(subject.L_d, "forces", None)
    return forces is not None and getattr(subject.L_d, "friction", True) is not None
