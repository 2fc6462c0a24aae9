"""Whether the derivative that autograd reports is the derivative of the map: p, c and DΦ̃ come from one autograd.

An L_d that hides a dependence from autograd (a detached potential, a table read with `numpy.interp`) gives p, c and DΦ̃
that belong together, and every identity between them holds. Differences of the map itself see the dependence.
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
NARROW = (0.1, 1e-3)  # of the offset: further differences, where the first do not agree
COARSE = 0.01  # to which narrow differences must agree with the wide: only a wide stencil sees a jump
VARIES = 1e4  # roundings of a component: with a smaller spread the component is constant
MOST = 4096  # steps in all: the points are drawn from all rollouts, 170 of one coordinate, 48 of ten


def derivative(subject: Subject, w: SampledRollout) -> Check:
    """Compare DΦ̃ at steps of all rollouts with central differences, in units of the components' spreads.

    A jump is seen where a stencil meets it, so there are many points: each covers 8 % of a spread. A map that bends
    within 8 % (near a wall, a collision) is compared with narrower differences, and by `COARSE` with the wide.
    The error is the largest |ΔDΦ̃_ij| spread_j, over the largest |DΦ̃_ij| spread_j of row i.

    Set-valued friction has kinks, at which no derivative exists. Samples are judged whose stencil, wide or narrow,
    stays on one branch of the map; wide differences do not count where narrow ones do, as Stribeck's curve bends
    sharply. Of other forces nobody knows where the kinks are: the median of the samples is judged.
    """
    x = torch.cat([w.q[:, :-1], w.p[:, :-1], w.s[:, :-1, None]], -1)[w.ok]
    count, make = MOST // (2 * len(WEIGHTS) * x.shape[-1]), torch.Generator().manual_seed(0)
    spread, keep = _spread(x), torch.randperm(len(x), generator=make)[: max(4, count)].to(x.device)
    x, D = x[keep], w.derivative[w.ok][keep]
    wide = _errors(subject, x, D, spread, OFFSET[x.dtype])
    bound = max(AGREES[x.dtype], rounded(0.0, w) / OFFSET[x.dtype])
    of_sample, bent = wide.clone(), ~(wide <= bound)
    if bool(bent.any()):
        widths = (share * OFFSET[x.dtype] for share in NARROW)
        for narrow in (_errors(subject, x[bent], D[bent], spread, width) for width in widths):
            of_sample[bent] = torch.fmin(of_sample[bent], narrow)
        if not subject.sticks:
            of_sample[bent] = torch.maximum(of_sample[bent], bound / COARSE * wide[bent])
    found = of_sample[~of_sample.isnan()]
    left_out = len(x) - len(found)
    beside = "a step beside them failed" + (", or changes between sliding and standing still" if subject.sticks else "")
    note = f"{left_out} of {len(x)} samples left out: {beside}" if left_out else ""
    value, how = worst(found), ": central differences"
    if (subject.forced or _has_forces(subject)) and not subject.sticks:
        value, how = float(found.median()) if len(found) else float("nan"), " (median of differences)"
    claim = f"{subject.derivative_of} DΦ̃ is the derivative{how}"
    return Check.at_most("derivative", claim, value, bound, note)


def _errors(subject: Subject, x: Tensor, D: Tensor, spread: Tensor, offset: float) -> Tensor:
    """The largest error of a sample, (B), over the largest entry of the row; NaN where no differences exist."""
    with torch.no_grad():
        found = central_differences(lambda y: stepped(subject.step, y, subject.h), x, offset * spread, subject.sticks)
    scaled, error = D.abs() * spread, (D - found).abs() * spread
    error = error / scaled.amax((0, -1))[:, None] if len(scaled) else error
    return error.flatten(1).amax(-1)


def _spread(x: Tensor) -> Tensor:
    """Standard deviation of every component; of a constant component the size, or 1."""
    if not len(x):
        return torch.ones_like(x[0:1].sum(0))
    spread, floor = x.std(0, correction=0), x.abs().amax(0)
    spread = torch.where(spread > VARIES * torch.finfo(x.dtype).eps * floor, spread, floor)
    return torch.where(spread > 0, spread, 1.0)


def _has_forces(subject: Subject) -> bool:
    forces = getattr(subject.L_d, "forces", None)
    return forces is not None and getattr(subject.L_d, "friction", True) is not None
