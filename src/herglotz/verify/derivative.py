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
# rounding are of one size there; float32: rounding decides.
OFFSET = {torch.float64: 0.01, torch.float32: 0.1}
# Sound maps leave 5e-14 to 9e-12 in float64 (every scene, 32 samples). A potential that autograd does not see leaves
# 0.1 at h = 0.1 and 0.001 at h = 0.001.
AGREES = {torch.float64: 1e-6, torch.float32: 1e-2}
NARROW = (0.1, 1e-3)  # of the offset: further differences, where the first do not agree
COARSE = 0.01  # that these must agree with the wide ones to: a jump is seen by a wide stencil only
VARIES = 1e4  # roundings of a component: a smaller spread is that of one value
MOST = 4096  # steps in all: the points are drawn from all rollouts, 170 of one coordinate, 48 of ten


def derivative(subject: Subject, w: SampledRollout) -> Check:
    """Compare DΦ̃ at steps of all rollouts with central differences, in units of the components' spreads.

    A jump is seen where a stencil meets it, so there are many points: each covers 8 % of a spread. A map that bends
    within that (near a wall, a collision) is compared with narrower differences, and by `COARSE` with the wide ones.
    The error is the largest |ΔDΦ̃_ij| spread_j, over the largest |DΦ̃_ij| spread_j of row i. Forces that hold and slide
    (set-valued friction) have kinks, at which no derivative exists: with forces the median of the samples is judged.
    """
    x = torch.cat([w.q[:, :-1], w.p[:, :-1], w.s[:, :-1, None]], -1)[w.ok]
    count, make = MOST // (2 * len(WEIGHTS) * x.shape[-1]), torch.Generator().manual_seed(0)
    spread, keep = _spread(x), torch.randperm(len(x), generator=make)[: max(4, count)].to(x.device)
    x, D = x[keep], w.derivative[w.ok][keep]
    of_sample, sound = _errors(subject, x, D, spread, OFFSET[x.dtype])
    bound = max(AGREES[x.dtype], rounded(0.0, w) / OFFSET[x.dtype])
    bent = (of_sample > bound).nonzero()[:, 0]
    if len(bent):
        least = of_sample[bent]
        for share in NARROW:
            narrow, fine = _errors(subject, x[bent], D[bent], spread, share * OFFSET[x.dtype])
            least = torch.where(fine, torch.minimum(narrow, least), least)
        of_sample[bent] = torch.maximum(least, bound / COARSE * of_sample[bent])
    of_sample = of_sample[sound]
    left_out = int((~sound).sum())
    note = f"{left_out} of {len(x)} samples left out: a step beside them failed" if left_out else ""
    if subject.forced or _has_forces(subject):
        value = float(of_sample.median()) if len(of_sample) else float("nan")
        claim = "autograd DΦ̃ is the derivative (median of differences)"
    else:
        value, claim = worst(of_sample), "autograd DΦ̃ is the derivative: central differences"
    return Check.at_most("derivative", claim, value, bound, note)


def _errors(subject: Subject, x: Tensor, D: Tensor, spread: Tensor, offset: float) -> tuple[Tensor, Tensor]:
    """The largest error of a sample, (B), over the largest entry of its row; and where differences exist, (B)."""
    with torch.no_grad():
        found = central_differences(lambda y: stepped(subject.step, y, subject.h), x, offset * spread)
    sound = found.isfinite().all(-1).all(-1)
    scaled, error = D.abs() * spread, (D - found).abs() * spread
    error = error / scaled.amax((0, -1))[:, None] if len(scaled) else error
    return error.flatten(1).amax(-1), sound


def _spread(x: Tensor) -> Tensor:
    """Standard deviation of every component; of one that does not vary its size, or 1."""
    if not len(x):
        return torch.ones_like(x[0:1].sum(0))
    spread, floor = x.std(0, correction=0), x.abs().amax(0)
    spread = torch.where(spread > VARIES * torch.finfo(x.dtype).eps * floor, spread, floor)
    return torch.where(spread > 0, spread, 1.0)


def _has_forces(subject: Subject) -> bool:
    forces = getattr(subject.L_d, "forces", None)
    return forces is not None and getattr(subject.L_d, "friction", True) is not None
