"""Rollouts with the derivative of every step, and the checks of single steps on them.

The derivative DΦ̃ that autograd reports is checked by finite differences of the map. An L_d can hide a dependence from
autograd (a detached potential, a table read with `numpy.interp`). p, c and DΦ̃ come from the same autograd and satisfy
every identity; only differences of the map show the dependence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from herglotz.export.differences import WEIGHTS, central_differences, stepped
from herglotz.mechanics import Forces, contact_defect, contact_form, flow_derivative
from herglotz.mechanics.newton import select
from herglotz.stepping import State, Status, Step
from herglotz.verify.report import Check
from herglotz.verify.subject import Map, Subject


@dataclass(frozen=True)
class SampledRollout:
    """B rollouts of K steps with the reported c and the derivative DΦ̃ of every step.

    `sticks` says whether set-valued dry friction can hold a coordinate.
    """

    q: Tensor  # (B, K+1, n)
    p: Tensor  # (B, K+1, n)
    s: Tensor  # (B, K+1)
    c: Tensor  # (B, K)
    status: Tensor  # (B, K)
    derivative: Tensor  # (B, K, 2n+1, 2n+1)
    sticks: bool = False

    @property
    def ok(self) -> Tensor:
        """Return whether each step converged with finite c and derivative, (B, K)."""
        finite = torch.isfinite(self.derivative).all(-1).all(-1) & torch.isfinite(self.c)
        return (self.status == Status.CONVERGED) & finite

    @property
    def slides(self) -> Tensor:
        """Return whether each coordinate moves in each step, (B, K, n); all do if no friction can hold a coordinate."""
        moves = self.q[:, 1:] != self.q[:, :-1]
        return moves if self.sticks else torch.ones_like(moves)

    @property
    def numbers(self) -> Tensor:
        """The numbers k of the steps that are ok."""
        return torch.arange(self.steps).expand_as(self.c)[self.ok]

    @property
    def starts(self) -> State:
        """The states before the steps that are ok."""
        return State(*(x[:, :-1][self.ok] for x in (self.q, self.p, self.s)))

    @property
    def ends(self) -> State:
        """The states after the steps that are ok."""
        return State(*(x[:, 1:][self.ok] for x in (self.q, self.p, self.s)))

    @property
    def steps(self) -> int:
        """Number of steps K."""
        return self.c.shape[-1]


def sampled_rollout(subject: Subject, steps: int) -> SampledRollout:
    """Roll out from the subject's states and differentiate every step by autograd."""
    frozen = _FrozenOnFailure(subject)
    with torch.no_grad():
        out = frozen.rollout(*subject.states, h=subject.h, steps=steps)
    each = subject.at(torch.arange(steps).repeat(len(out.s)))
    _, D = flow_derivative(each.flow(), *(x[:, :-1].flatten(0, 1) for x in (out.q, out.p, out.s)))
    c = torch.stack(frozen.factors, 1)
    return SampledRollout(out.q, out.p, out.s, c, out.status, D.unflatten(0, (-1, steps)), subject.sticks)


class _FrozenOnFailure(Map):
    """The map with the identity for samples whose step failed, because a batch needs finite inputs."""

    def __init__(self, subject: Subject):
        super().__init__(subject)
        self.factors: list[Tensor] = []

    def step(self, state: State, h: Any, guess: Tensor | None = None) -> Step:
        """The next step; a sample that is not finite is DIVERGED. The factors c of all steps are kept."""
        step = super().step(state, h, guess)
        self.factors.append(step.c)
        good = torch.isfinite(torch.cat([*step.state[:2], step.state.s[:, None]], -1)).all(-1)
        status = torch.where(~good & (step.status == Status.CONVERGED), int(Status.DIVERGED), step.status)
        state = State(*select(good, tuple(step.state), tuple(state)))
        return Step(state, torch.where(good, step.c, 1.0), status, step.residual, step.iterations)


# Roundings of q allowed in an identity of p. The worst of 90 measurements with q about 1e5 and 1e7 (a quartic
# oscillator, two coupled masses and Kepler; h = 0.01, 0.1, 0.5; five seeds) was 13 for a step and 54 for D1S^k over
# eight steps.
ROUNDINGS = 100.0
# No bound is raised beyond this, because null models exceed 1e-3.
MAX_RAISED_BOUND = 1e-4


def rounded(bound: float, w: SampledRollout) -> float:
    """Return the larger of the bound and the error of p that the rounding of q alone causes.

    q has the error eps |q|, and p that error times the slope |c (∂q1/∂p0)⁻¹|. Far from the origin of q, with p of size
    1, no stepper satisfies an identity of p to 1e-11.
    """
    if not bool(w.ok.any()):
        return bound
    n, D = w.q.shape[-1], w.derivative[w.ok]
    slope = torch.linalg.inv_ex(D[:, :n, n : 2 * n])[0] * w.c[w.ok][:, None, None]
    p = w.starts.p.abs().max()
    size = torch.finfo(w.q.dtype).eps * w.q.abs().max() * slope.abs().max() / torch.where(p > 0, p, 1.0)
    return max(bound, min(ROUNDINGS * float(size), MAX_RAISED_BOUND)) if bool(torch.isfinite(size)) else bound


def worst(values: Tensor) -> float:
    """Return the largest entry; NaN, which fails every bound, if `values` is empty or has a NaN."""
    return float(values.max()) if values.numel() else float("nan")


def convergence(w: SampledRollout) -> Check:
    """Check that every step of every rollout converged."""
    failed = w.status != Status.CONVERGED
    counts = ", ".join(f"{int((w.status == k).sum())} {k.name}" for k in Status if k and bool((w.status == k).any()))
    return Check.at_most("converged", "every step converges (share failed)", float(failed.double().mean()), 0.0, counts)


def positive_factor(w: SampledRollout) -> Check:
    """Check c > 0 at every step: FL⁻ exists and the map keeps the orientation."""
    c = w.c[w.ok]
    return Check.more_than("positive_c", "conformal factor c > 0 (smallest)", -worst(-c), 0.0)


def contact(w: SampledRollout, bound: float, force: Forces | None = None) -> Check:
    """Check DΦ̃ᵀ η(x1) = c η(x0) − F⁻dq0 − F⁺dq1, relative to the terms that cancel.

    Without forces this is the contact property. `force` contains the forces at the steps that are ok.
    """
    p0, p1 = w.starts.p, w.ends.p
    D, c = w.derivative[w.ok], w.c[w.ok]
    defect, claim = contact_defect(D, p0, p1, c), "contact map: DΦ̃ᵀη(x1) = c η(x0)"
    if force is not None:
        n = p0.shape[-1]
        defect = defect + (D[..., :n, :].mT @ force.plus[..., None])[..., 0]
        defect = torch.cat([defect[..., :n] + force.minus, defect[..., n:]], -1)
        claim = "forced contact map: DΦ̃ᵀη(x1) = c η(x0) − F⁻dq0 − F⁺dq1"
    pulled = (D.abs().mT @ contact_form(p1).abs()[..., None])[..., 0]
    size = (pulled + c.abs()[..., None] * contact_form(p0).abs()).amax(-1)
    return Check.at_most("contact", claim, worst(defect.abs().amax(-1) / size), bound)


def volume(w: SampledRollout, bound: float) -> Check:
    """Check the volume factor det DΦ̃ = c^{n+1}, relative."""
    n = w.q.shape[-1]
    ratio = torch.linalg.det(w.derivative[w.ok]) / w.c[w.ok] ** (n + 1)
    return Check.at_most("volume", "volume: det DΦ̃ = c^(n+1)", worst((ratio - 1).abs()), bound)


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
