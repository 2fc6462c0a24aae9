"""Rollouts with the derivative of every step, and the checks of single steps on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from herglotz.mechanics import Forces, contact_defect, contact_form, flow_derivative
from herglotz.mechanics.newton import select
from herglotz.stepping import State, Status, Step
from herglotz.verify.report import Check
from herglotz.verify.subject import Map, Subject


@dataclass(frozen=True)
class SampledRollout:
    """B rollouts of K steps with the derivative of every step, measured on the map itself."""

    q: Tensor  # (B, K+1, n)
    p: Tensor  # (B, K+1, n)
    s: Tensor  # (B, K+1)
    c: Tensor  # (B, K) as the stepper reports it
    status: Tensor  # (B, K)
    derivative: Tensor  # (B, K, 2n+1, 2n+1) DΦ̃ at entry k
    sticks: bool = False  # whether set-valued dry friction can hold a coordinate

    @property
    def ok(self) -> Tensor:
        """Return whether each step converged with finite c and derivative, (B, K)."""
        finite = torch.isfinite(self.derivative).all(-1).all(-1) & torch.isfinite(self.c)
        return (self.status == Status.CONVERGED) & finite

    @property
    def slides(self) -> Tensor:
        """Return whether each coordinate moves in each step, or no friction can hold it, (B, K, n)."""
        moves = self.q[:, 1:] != self.q[:, :-1]
        return moves if self.sticks else torch.ones_like(moves)

    @property
    def starts(self) -> State:
        """The states before the steps that are ok."""
        return State(*(x[:, :-1][self.ok] for x in (self.q, self.p, self.s)))

    @property
    def ends(self) -> State:
        """The states after them."""
        return State(*(x[:, 1:][self.ok] for x in (self.q, self.p, self.s)))

    @property
    def steps(self) -> int:
        """Number of steps K."""
        return self.c.shape[-1]


def sampled_rollout(subject: Subject, steps: int) -> SampledRollout:
    """Roll out from the subject's states and differentiate every step by autograd."""
    held = _Held(subject.step, subject.h)
    with torch.no_grad():
        out = held.rollout(*subject.states, h=subject.h, steps=steps)
    _, D = flow_derivative(subject.flow(), *(x[:, :-1].flatten(0, 1) for x in (out.q, out.p, out.s)))
    c = torch.stack(held.factors, 1)
    return SampledRollout(out.q, out.p, out.s, c, out.status, D.unflatten(0, (-1, steps)), subject.sticks)


class _Held(Map):
    """The map, where a sample whose step failed stays where it was: a batch needs finite inputs."""

    def __init__(self, one: Callable[[State, float], Step], h: float):
        super().__init__(one, h)
        self.factors: list[Tensor] = []  # c of every step

    def step(self, state: State, h: Any, guess: Tensor | None = None) -> Step:  # noqa: ARG002
        """One step; what is not finite has a status."""
        step = self.one(state, self.h)
        self.factors.append(step.c)
        good = torch.isfinite(torch.cat([*step.state[:2], step.state.s[:, None]], -1)).all(-1)
        status = torch.where(~good & (step.status == Status.CONVERGED), int(Status.DIVERGED), step.status)
        state = State(*select(good, tuple(step.state), tuple(state)))
        return Step(state, torch.where(good, step.c, 1.0), status, step.residual, step.iterations)


# Of q in one step. The worst of 90 far away (a quartic oscillator, two coupled masses and Kepler, q about 1e5 and 1e7,
# h = 0.01, 0.1, 0.5, five seeds): 13 for a step, 54 for D1S^k over eight.
ROUNDINGS = 100.0
BLIND = 1e-4  # no bound is raised beyond this: null models exceed 1e-3


def rounded(bound: float, w: SampledRollout) -> float:
    """Return the bound, or what the rounding of q alone leaves in p where that is more.

    q is known to eps |q| and p follows with the slope |c (∂q1/∂p0)⁻¹|: far from the origin of q, with p of
    size 1, no stepper keeps an identity of p to 1e-11.
    """
    if not bool(w.ok.any()):
        return bound
    n, D = w.q.shape[-1], w.derivative[w.ok]
    slope = torch.linalg.inv_ex(D[:, :n, n : 2 * n])[0] * w.c[w.ok][:, None, None]
    p = w.starts.p.abs().max()
    size = torch.finfo(w.q.dtype).eps * w.q.abs().max() * slope.abs().max() / torch.where(p > 0, p, 1.0)
    return max(bound, min(ROUNDINGS * float(size), BLIND)) if bool(torch.isfinite(size)) else bound


def worst(values: Tensor) -> float:
    """Return the largest entry; NaN, which fails every bound, where `values` is empty or has a NaN."""
    return float(values.max()) if values.numel() else float("nan")


def convergence(w: SampledRollout) -> Check:
    """Check that every step of every rollout converged."""
    failed = w.status != Status.CONVERGED
    counts = ", ".join(f"{int((w.status == k).sum())} {k.name}" for k in Status if k and bool((w.status == k).any()))
    return Check.at_most("converged", "every step converges (share failed)", float(failed.double().mean()), 0.0, counts)


def positive_factor(w: SampledRollout) -> Check:
    """Check c > 0 at every step, so that FL⁻ exists and orientation is kept."""
    c = w.c[w.ok]
    return Check.more_than("positive_c", "conformal factor c > 0 (smallest)", -worst(-c), 0.0)


def contact(w: SampledRollout, bound: float, force: Forces | None = None) -> Check:
    """Check DΦ̃ᵀ η(x1) = c η(x0) − F⁻dq0 − F⁺dq1, relative to the terms that cancel.

    Without forces this is the contact property. `force` holds the forces at the steps that are ok.
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
