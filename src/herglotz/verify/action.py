"""Checks of the generating functions S^k and of the discrete Hamilton–Jacobi equation.

S^k(q̂0, q_k, ŝ0) = s_k − ŝ0 comes from the flow, its derivatives from the endpoint map, H⁺ from L_d and H⁻ from L⁻. No
side of an identity is computed by that identity.

Every step of a time-dependent L_d has its own L_d^k = L_d(·; t_k), and time has momenta.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from herglotz.mechanics import (
    Partials,
    mixed_hessian,
    partials,
)
from herglotz.mechanics.contact import flow_derivatives
from herglotz.mechanics.legendre import left_hessian, scaled_margin
from herglotz.stepping import State
from herglotz.theory import (
    GeneratingFunction,
    LeftHamiltonian,
    RightHamiltonian,
    TimeDependent,
    energies,
    hamilton_jacobi_residual,
    left_hamilton_jacobi_residual,
    right_hamiltonian_on_flow,
    time_defect,
)
from herglotz.verify.legendre import LEFT, RIGHT
from herglotz.verify.report import Check
from herglotz.verify.sampled_rollout import SampledRollout, worst
from herglotz.verify.subject import Subject

# Momenta p̂0 from each start (q̂0, ŝ0). The fans of all starts cover an open set of q_k, which erratum E7 requires.
FAN_MOMENTA = 4
# Standard deviation of p̂0 within a fan, relative to that over all starts.
FAN_WIDTH = 0.1
# S^k is left out near a caustic: where the spread of a fan is below this share of k times the spread after one step.
MIN_RELATIVE_SPREAD = 1e-2
# H⁺ and H⁻ are left out near a fold: where their `scaled_margin` is below this. Steps do not need H± (E4).
MIN_FOLD_MARGIN = 1e-3

ALTERNATES = "one of S^k and S^(k+1) is beside a caustic, for all k that were tried"


@dataclass(frozen=True)
class Fan:
    """Solutions from common starts (q̂0, ŝ0) with different p̂0, and their S^k for some k.

    The dictionaries are by k. `sigma` is the product of the reported c; `keep` marks solutions away from a caustic;
    `failed` counts the solutions that were dropped, because a step failed or has no finite derivative.
    """

    start: State  # (F, n), (F, n), (F)
    S: dict[int, GeneratingFunction]
    sigma: dict[int, Tensor]  # (F)
    keep: dict[int, Tensor]  # (F)
    failed: int = 0

    @property
    def pairs(self) -> list[int]:
        """Every k with S^k and S^{k+1}."""
        return [k for k in self.S if k + 1 in self.S]

    def alternates(self) -> bool:
        """Whether S^k is away from caustics for some k but never for k and k + 1 together, though no step failed."""
        some = any(bool(keep.any()) for keep in self.keep.values()) and not self.failed
        return some and not any(bool((self.keep[k] & self.keep[k + 1]).any()) for k in self.pairs)

    def left_out(self) -> str:
        """Return a note on how many solutions the checks leave out, empty if none."""
        failed = self.failed * len(self.keep)
        lost = sum(int((~keep).sum()) for keep in self.keep.values()) + failed
        total = sum(keep.numel() for keep in self.keep.values()) + failed
        return f"{lost} of {total} solutions left out: near a caustic or not converged" if lost else ""


def fan(subject: Subject, steps: int, seed: int) -> Fan:
    """Draw a fan of momenta at every state, and differentiate the k-step maps for k = 1, 2, K−1, K."""
    q, p, s = subject.states
    make = torch.Generator().manual_seed(seed)
    size = p.std(0, correction=0) if len(p) > 1 else p.abs()[0]
    size = torch.where(size > 0, size, 1.0)
    offset = torch.randn(len(p), FAN_MOMENTA, p.shape[-1], generator=make, dtype=torch.float64).to(p)
    offset[:, 0] = 0.0
    momenta = p[:, None] + FAN_WIDTH * size * offset
    start = State(
        q[:, None].expand_as(momenta).flatten(0, 1),
        momenta.flatten(0, 1),
        s[:, None].expand(momenta.shape[:-1]).flatten(),
    )
    counts = sorted({1, 2, steps - 1, steps})
    flows = [subject.flow(k - before, before) for before, k in pairwise([0, *counts])]
    found = flow_derivatives(flows, *start)
    end, D = found[-1]
    sound = torch.isfinite(D).all(-1).all(-1) & torch.isfinite(end[2])
    S = {k: GeneratingFunction.of(start.s, *x).map(lambda y: y[sound]) for k, x in zip(counts, found, strict=True)}
    start = State(*(x[sound] for x in start))
    with torch.no_grad():
        sigma = dict(enumerate(subject.rollout(start, steps).sigma.unbind(-1)))
    keep = {k: usable(g, S[1], k) & torch.isfinite(sigma[k]) for k, g in S.items()}
    return Fan(start, S, sigma, keep, int((~sound).sum()))


def derivatives(f: Fan, bound: float, bound_of_c: float) -> list[Check]:
    """Check D2S^k = p_k, D1S^k = −σ_k p̂0 and 1 + D3S^k = σ_k, relative to the largest momentum and to σ_k."""
    size = max([worst(f.start.p.abs())] + [worst(g.p[f.keep[k]].abs()) for k, g in f.S.items() if f.keep[k].any()])

    def largest(error: Callable[[int, GeneratingFunction], Tensor]) -> float:
        return worst(torch.cat([error(k, g)[f.keep[k]].reshape(-1) for k, g in f.S.items()]))

    note = f.left_out()
    D2 = largest(lambda _, g: (g.D2 - g.p).abs() / size)
    D1 = largest(lambda k, g: (g.D1 + f.sigma[k][..., None] * f.start.p).abs() / size)
    D3 = largest(lambda k, g: ((1 + g.D3) / f.sigma[k] - 1).abs())
    return [
        Check.at_most("D2S", "generating function: D2 S^k = p_k", D2, bound, note),
        Check.at_most("D1S", "generating function: D1 S^k = −σ_k p0", D1, bound, note),
        Check.at_most("D3S", "conformal product: 1 + D3 S^k = σ_k", D3, bound_of_c, note),
    ]


# (L_d of the step, S^k, S^{k+1}) → the residual, and two of its terms
Side = Callable[[Any, GeneratingFunction, GeneratingFunction], tuple[Tensor, Tensor, Tensor]]


def hamilton_jacobi(subject: Subject, f: Fan, bound: float) -> Check:
    """Check S^{k+1}(q_{k+1}) − S^k(q_k) − dS^{k+1}·q_{k+1} + H⁺(q_k, dS^{k+1}, s_k) = 0, relative to its terms.

    H⁺ comes from L_d by a Newton solve of D2 L_d(q_k, ·, s_k) = dS^{k+1}, not from the flow. If the target has no L_d,
    H⁺ is p1·q1 − (s1 − s0) along the step.
    """

    def side(L_d: Any, before: GeneratingFunction, after: GeneratingFunction) -> tuple[Tensor, Tensor, Tensor]:
        if L_d is None:
            H = right_hamiltonian_on_flow(after.q, after.p, after.s - before.s)
        else:
            # The guess selects the branch of H⁺. An error of 1e-3 steps in the guess makes the solver iterate.
            guess = after.q + 1e-3 * (after.q - before.q)
            H = RightHamiltonian(L_d, guess)(before.q, after.D2, before.s, subject.h)
        residual = hamilton_jacobi_residual(after.S, before.S, after.D2, after.q, H)
        return residual, (after.D2 * after.q).sum(-1), H

    if f.alternates():
        return Check.without_object("hamilton_jacobi", RIGHT, ALTERNATES)
    note = "no L_d in the file: H⁺ rebuilt as p1·q1 − (s1 − s0)" if subject.L_d is None else ""
    value, notes = _on_fan(subject, f, side, lambda P: P.D22, "a fold of H⁺ (det D2D2 L_d = 0)")
    return Check.at_most("hamilton_jacobi", RIGHT, value, bound, "; ".join([*notes, note] if note else notes))


def left_hamilton_jacobi(subject: Subject, f: Fan, bound: float) -> Check:
    """Check S^{k+1}(q_{k+1}) − S^k(q_k) + dS^k·q_k + H⁻(dS^k, q_{k+1}, s_{k+1}) = 0 (erratum E6), over its terms.

    H⁻ comes from L_d by Newton solves of s0 + L_d = s_{k+1} and −D1L⁻ = dS^k, not from the flow.
    """

    def side(L_d: Any, before: GeneratingFunction, after: GeneratingFunction) -> tuple[Tensor, Tensor, Tensor]:
        # An error of 1e-3 steps in the guess makes the solver iterate.
        guess = before.q - 1e-3 * (after.q - before.q)
        H = LeftHamiltonian(L_d, guess)(before.D2, after.q, after.s, subject.h)
        residual = left_hamilton_jacobi_residual(after.S, before.S, before.D2, before.q, H)
        return residual, (before.D2 * before.q).sum(-1), H

    if f.alternates():
        return Check.without_object("left_hamilton_jacobi", LEFT, ALTERNATES)
    value, notes = _on_fan(subject, f, side, left_hessian, "a fold of H⁻ (det D1D1 L⁻ = 0)")
    return Check.at_most("left_hamilton_jacobi", LEFT, value, bound, "; ".join(notes))


def _on_fan(
    subject: Subject, f: Fan, side: Side, hessian: Callable[[Partials], Tensor], fold: str
) -> tuple[float, list[str]]:
    """The largest residual over the largest sum of its terms, where S^k, S^{k+1} and the Hamiltonian exist; notes."""
    residuals, sizes, folds = [], [], 0
    for k in f.pairs:
        before, after, L_d = f.S[k], f.S[k + 1], subject.at(k).L_d
        keep = f.keep[k] & f.keep[k + 1]
        with torch.no_grad():
            if L_d is not None:
                P = partials(L_d, before.q, after.q, before.s, subject.h, 2)
                regular = scaled_margin(hessian(P), mixed_hessian(P), P.D11, P.D22) > MIN_FOLD_MARGIN
                folds += int((keep & ~regular).sum())
                keep = keep & regular
            b, a = (g.map(lambda x, keep=keep: x[keep]) for g in (before, after))
            residual, pairing, H = side(L_d, b, a)
            residuals.append(residual.abs())
            sizes.append(a.S.abs() + b.S.abs() + pairing.abs() + H.abs())
    notes = [f.left_out()] if f.left_out() else []
    notes += [f"{folds} left out near {fold}"] if folds else []
    size = worst(torch.cat(sizes))
    return (worst(torch.cat(residuals)) / size if size > 0 else float("nan")), notes


def usable(g: GeneratingFunction, one: GeneratingFunction, k: int) -> Tensor:
    """Return whether S^k is away from a caustic: the spread of the fan is compared with k free steps."""
    return (g.spread > MIN_RELATIVE_SPREAD * k * one.spread) & torch.isfinite(g.D2).all(-1) & torch.isfinite(g.S)


def time_form(subject: Subject, w: SampledRollout, bound: float) -> Check:
    """Check that the steps of a time-dependent L_d keep η + E dt up to c, relative to the energies E."""
    family, start = subject.L_d, w.starts
    assert isinstance(family, TimeDependent)
    t = family.t0 + subject.h * w.numbers.to(start.s)
    by_t, by_h = time_defect(family, start, t, subject.h)
    E = torch.stack(energies(family.L_d, start.q, w.ends.q, start.s, t, subject.h)).abs()
    value = worst(torch.stack([by_t, by_h]).abs() / E.sum(0).clamp_min(torch.finfo(E.dtype).tiny))
    return Check.at_most("time", "time: step keeps η + E dt up to c", value, bound)
