"""The rows of `verify` for a time-dependent L_d: every step has its own L_d^k = L_d(·; t_k), and time has momenta."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from herglotz.mechanics import flow_derivative, momentum_jacobian, momentum_plus, momentum_residual, partials
from herglotz.mechanics.contact import Flow
from herglotz.stepping import State, Status, Stepper, solve
from herglotz.theory import TimeDependent, energies, generating_function, time_defect
from herglotz.verify.action import CAUSTIC, Fan, derivatives, hamilton_jacobi, left_hamilton_jacobi
from herglotz.verify.report import Check
from herglotz.verify.sampled_rollout import SampledRollout, contact, convergence, positive_factor, volume, worst
from herglotz.verify.subject import Subject


def in_time(known: Subject, family: TimeDependent, steps: int, strict: float, bound: float) -> list[Check]:
    """The checks of motions whose k-th step begins at t_k = t0 + kh.

    Parameters
    ----------
    known
        The subject whose L_d is `family`.
    family
        L_d with the time t0 at which the motions begin.
    steps
        K, the steps of a motion.
    strict, bound
        Of the contact property, and of the other identities.
    """
    members = [replace(known, L_d=family.at(_time(family, k, known.h))) for k in range(steps)]
    w = _rollout(members, known.states)
    q0, p0, s0 = (x[:, :-1][w.ok] for x in (w.q, w.p, w.s))
    t = torch.cat([_time(family, k, known.h) for k in range(steps)]).to(w.s).expand_as(w.c)[w.ok]
    by_t, by_h = time_defect(family, State(q0, p0, s0), t, known.h)
    E = torch.stack(energies(family.L_d, q0, w.q[:, 1:][w.ok], s0, t, known.h)).abs()
    time = worst(torch.stack([by_t, by_h]).abs() / E.sum(0).clamp_min(torch.finfo(E.dtype).tiny))
    fan = _fan(members, known.states, w)
    checks = [convergence(w), positive_factor(w), contact(w, strict), volume(w, bound)]
    checks.append(Check.at_most("time", "time: step keeps η + E dt up to c", time, bound))
    checks.append(_matching(members, w, bound))
    checks += derivatives(fan, bound, bound)
    for check in (hamilton_jacobi, left_hamilton_jacobi):
        rows = [
            check(members[k], replace(fan, S={j: fan.S[j] for j in (k, k + 1)}), bound) for k in fan.S if k + 1 in fan.S
        ]
        checks.append(max(rows, key=lambda row: (row.value != row.value, row.value)))
    return checks


def _time(family: TimeDependent, k: int, h: float) -> Tensor:
    """t_k, (1,)."""
    return (torch.as_tensor(family.t0, dtype=torch.float64) + k * h).reshape(1)


def _stepped(members: list[Subject], k: int) -> Flow:
    """The map of the first k steps."""

    def flow(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        state = State(q, p, s)
        for member in members[:k]:
            state = _step(member, state)
        return state

    return flow


def _step(member: Subject, state: State) -> State:
    assert member.L_d is not None
    return Stepper(member.L_d).step(state, member.h).state


def _rollout(members: list[Subject], start: State) -> SampledRollout:
    """Motions with the derivative of every step; a sample whose step fails stays NaN, and is not ok."""
    states, rows = [start], []
    for member in members:
        assert member.L_d is not None
        step = Stepper(member.L_d).step(states[-1], member.h)
        _, D = flow_derivative(_stepped([member], 1), *states[-1])
        states.append(State(*(x.detach() for x in step.state)))
        rows.append((step.c.detach(), step.status, D))
    c, status, D = (torch.stack(x, 1) for x in zip(*rows, strict=True))
    q, p, s = (torch.stack([getattr(x, name) for x in states], 1) for name in ("q", "p", "s"))
    return SampledRollout(q, p, s, c, status, D)


def _fan(members: list[Subject], start: State, w: SampledRollout) -> Fan:
    """S^k for k = 1, 2, K − 1, K along the motions, where all their steps converged."""
    whole = (w.status == Status.CONVERGED).all(-1)
    start = State(*(x[whole] for x in start))
    count = len(members)
    S = {k: generating_function(_stepped(members, k), *start) for k in sorted({1, 2, count - 1, count})}
    sigma = dict(enumerate(w.c[whole].cumprod(-1).unbind(-1), 1))
    keep = {k: (g.spread > CAUSTIC * k * S[1].spread) & torch.isfinite(g.D2).all(-1) for k, g in S.items()}
    return Fan(start, S, sigma, keep, int((~whole).sum()))


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
