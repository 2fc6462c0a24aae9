"""The checks of a time-dependent L_d: every step has its own L_d^k = L_d(·; t_k), and time has momenta."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from herglotz.mechanics import flow_derivative, momentum_jacobian, momentum_plus, momentum_residual, partials
from herglotz.mechanics.contact import Flow
from herglotz.stepping import State, Status, Stepper, solve
from herglotz.theory import TimeDependent, energies, generating_function, time_defect
from herglotz.verify.action import Fan, derivatives, hamilton_jacobi, left_hamilton_jacobi, usable
from herglotz.verify.report import Check
from herglotz.verify.sampled_rollout import SampledRollout, contact, convergence, positive_factor, volume, worst
from herglotz.verify.subject import Subject


def in_time(known: Subject, family: TimeDependent, steps: int, strict: float, bound: float) -> list[Check]:
    """Check motions of K = `steps` steps, of which step k begins at t_k = t0 + kh.

    `strict` bounds the contact property, `bound` the other identities.
    """
    times = torch.as_tensor(family.t0, dtype=known.states.s.dtype) + known.h * torch.arange(steps).to(known.states.s)
    members = [replace(known, L_d=family.at(t.reshape(1))) for t in times]
    w = _rollout(family, known, times)
    start = w.starts
    t = times.expand_as(w.c)[w.ok]
    by_t, by_h = time_defect(family, start, t, known.h)
    E = torch.stack(energies(family.L_d, start.q, w.ends.q, start.s, t, known.h)).abs()
    time = worst(torch.stack([by_t, by_h]).abs() / E.sum(0).clamp_min(torch.finfo(E.dtype).tiny))
    fan = _fan(family, known, w)
    checks = [convergence(w), positive_factor(w), contact(w, strict), volume(w, bound)]
    checks.append(Check.at_most("time", "time: step keeps η + E dt up to c", time, bound))
    checks.append(_matching(members, w, bound))
    checks += derivatives(fan, bound, bound)
    for check in (hamilton_jacobi, left_hamilton_jacobi):
        rows = [
            check(members[k], replace(fan, S={j: fan.S[j] for j in (k, k + 1)}), bound) for k in fan.S if k + 1 in fan.S
        ]
        checks.append(max(rows, key=lambda row: (row.applies, row.value != row.value, row.value)))
    return checks


def _rollout(family: TimeDependent, known: Subject, times: Tensor) -> SampledRollout:
    """Motions with the derivative of every step; a sample is NaN, and not ok, after a failed step."""
    with torch.no_grad():
        out = Stepper(family).rollout(*known.states, h=known.h, steps=len(times), inputs=times[:, None])
    t, h = times.expand(out.status.shape).flatten(), known.h
    q, p, s = (x[:, :-1].flatten(0, 1) for x in (out.q, out.p, out.s))
    _, D = flow_derivative(lambda *x: family.step_at(State(*x), t, h).state, q, p, s)
    c = partials(family.at(t[:, None]), q, out.q[:, 1:].flatten(0, 1), s, h).c.detach()
    c, D = (x.unflatten(0, out.status.shape) for x in (c, D))
    return SampledRollout(out.q, out.p, out.s, c, out.status, D)


def _fan(family: TimeDependent, known: Subject, w: SampledRollout) -> Fan:
    """S^k for k = 1, 2, K − 1, K along the motions whose steps all converged."""
    whole = (w.status == Status.CONVERGED).all(-1)
    start = State(*(x[whole] for x in known.states))

    def stepped(k: int) -> Flow:
        """The map of the first k steps."""
        return lambda q, p, s: family.rollout(State(q, p, s), float(family.t0), known.h, k).final

    S = {k: generating_function(stepped(k), *start) for k in sorted({1, 2, w.steps - 1, w.steps})}
    sigma = dict(enumerate(w.c[whole].cumprod(-1).unbind(-1), 1))
    return Fan(start, S, sigma, {k: usable(g, S[1], k) for k, g in S.items()}, int((~whole).sum()))


def _matching(members: list[Subject], w: SampledRollout, bound: float) -> Check:
    """Check R_k = D1L_d^k + c_k D2L_d^{k−1} = 0 with the times of both steps, as |J⁻¹R|/|q|."""
    both, errors = w.ok[:, :-1] & w.ok[:, 1:], []
    for k, (before, after) in enumerate(pairwise(members)):
        keep = both[:, k]
        assert before.L_d is not None
        assert after.L_d is not None
        p1 = momentum_plus(partials(before.L_d, w.q[keep, k], w.q[keep, k + 1], w.s[keep, k], before.h))
        P = partials(after.L_d, w.q[keep, k + 1], w.q[keep, k + 2], w.s[keep, k + 1], after.h, 2)
        errors.append(solve(momentum_jacobian(P, p1), momentum_residual(P, p1)).abs().reshape(-1))
    value = worst(torch.cat(errors)) / worst(w.q[w.q.isfinite()].abs())
    return Check.at_most("momentum", "momenta match: discrete Herglotz equation, |J⁻¹R|/|q|", value, bound)
