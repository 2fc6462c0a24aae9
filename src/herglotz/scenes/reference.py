"""The equations of motion of a contact system, and their reference flow, to near round-off.

The error of Gragg's modified midpoint rule is a series in the square of the step. The rule is extrapolated to order 12
(Gragg–Bulirsch–Stoer), in float64, and the number of substeps is doubled until a sample has converged. The same method
integrates Herglotz's action of any smooth path, the continuous Cauchy problem that L_d discretises.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import join, split
from herglotz.mechanics.partials import Lagrangian, derivatives
from herglotz.scenes.scene import State, StateFunction

Balance = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Motion:
    """The equations of motion of x = (q, y, s), where y is the momentum p or the velocity v, differentiable in x.

    No acceleration is needed. L_s is the rate of the conformal factor, ċ = c L_s.
    """

    start: StateFunction  # (q, v, s) → y
    balance: Balance  # (q, y, s) → (q̇, p, ṗ, ṡ, L_s)

    def vector_field(self, q: Tensor, p: Tensor, s: Tensor) -> State:
        """(q̇, ṗ, ṡ) of equations whose y is the momentum."""
        q_dot, _, p_dot, s_dot, _ = self.balance(q, p, s)
        return q_dot, p_dot, s_dot


def herglotz_motion(
    lagrangian: StateFunction,
    momentum: StateFunction,
    velocity: StateFunction,
    force: StateFunction,  # (q, v, s) → L_q, (..., n)
    rate: StateFunction,  # (q, v, s) → L_s, (...)
) -> Motion:
    """Return the equations in (q, p, s) by explicit derivatives, the fast form: q̇ = v, ṗ = L_q + L_s p, ṡ = L."""

    def balance(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        v = velocity(q, p, s)
        L_s = rate(q, v, s)
        return v, p, force(q, v, s) + L_s[..., None] * p, lagrangian(q, v, s), L_s

    return Motion(momentum, balance)


def constant_rate(L_s: float) -> StateFunction:
    """Return the rate L_s of a contact term linear in s, L = … + L_s s."""
    return lambda q, v, s: torch.full_like(s, L_s)  # noqa: ARG005


def lagrangian_motion(lagrangian: StateFunction) -> Motion:
    """Return the equations of L(q, v, s) in (q, v, s) by autograd: q̇ = v, ṗ = L_q + L_s p, ṡ = L."""

    def balance(q: Tensor, v: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        L = derivatives(lagrangian, q, v, s)
        return v, L.D2, L.D1 + L.D3[..., None] * L.D2, L.L, L.D3

    return Motion(lambda q, v, s: v, balance)  # noqa: ARG005


VectorField = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
Derivative = Callable[[Tensor], Tensor]

# Midpoint steps per column: order 12, 37 evaluations a substep. Extrapolation multiplies round-off by the sum of
# |weights|, 26 with these six columns. Two more columns would make the sum 119, above the tolerance at h ≥ 5.
SEQUENCE = (2, 4, 6, 8, 10, 12)

# Largest error of a sample, relative to 1 + |component|: a hundred times the rounding of a step.
TOLERANCE = 1e-13
# A sample that is not finite with this many substeps is given up.
MAX_SUBSTEPS_NOT_FINITE = 8


@dataclass(frozen=True)
class ReferenceSolution:
    """The end state of each sample and the estimated error."""

    q1: Tensor  # (..., n)
    p1: Tensor  # (..., n)
    s1: Tensor  # (...)
    error: Tensor  # (...) largest difference from half as many substeps, relative to 1 + |component|


def reference_solve(
    vector_field: VectorField,  # (q, p, s) → (q̇, ṗ, ṡ); for any H, partial(contact_vector_field, H)
    q: Tensor,  # (..., n)
    p: Tensor,  # (..., n)
    s: Tensor,  # (...)
    h: Tensor | float,  # () or (...), of either sign
    max_substeps: int = 128,
) -> ReferenceSolution:
    """Integrate (q, p, s) over time h, and estimate the error.

    A sample keeps the first result that agrees to `TOLERANCE` with the result of half as many substeps, or the result
    of `max_substeps`; samples do not influence each other. The result has the dtype of q, and is differentiable if the
    vector field is. `error` is that of the coarser of the last two results; the finer result is returned.
    """
    n, dtype = q.shape[-1], q.dtype
    h = torch.as_tensor(h, dtype=torch.float64, device=q.device)
    batch = torch.broadcast_shapes(q.shape[:-1], p.shape[:-1], s.shape, h.shape)
    x0 = join(q.expand(*batch, n), p.expand(*batch, n), s.expand(batch)).double()

    def f(x: Tensor) -> Tensor:
        return join(*vector_field(*split(x)))

    x, error = _integrated(f, x0, h.expand(batch), max_substeps)
    return ReferenceSolution(*split(x.to(dtype)), error)


def _integrated(f: Derivative, x0: Tensor, span: Tensor, max_substeps: int) -> tuple[Tensor, Tensor]:
    """Integrate ẋ = f(x) with 1, 2, 4, … substeps until two results of a sample agree.

    Return x at the end, (..., d), and the error of the coarser of the last two results, (...).
    """
    span, substeps = span[..., None], 2
    # The one substep of the coarse result and the first substep of the finer result are one batch.
    x, half = _extrapolated_step(f, x0.expand(2, *x0.shape), torch.stack([span, span / 2]))
    finer = _extrapolated_step(f, half, span / 2)
    error = torch.full(x0.shape[:-1], torch.inf, dtype=x0.dtype, device=x0.device)
    while True:
        difference = ((finer - x).abs() / (1.0 + finer.abs())).amax(-1).detach()
        done = error <= TOLERANCE
        x = torch.where(done[..., None], x, finer)
        error = torch.where(done, error, difference)
        given_up = ~torch.isfinite(error) & (substeps >= MAX_SUBSTEPS_NOT_FINITE)
        if substeps >= max_substeps or bool(((error <= TOLERANCE) | given_up).all()):
            return x, error
        substeps *= 2
        finer = x0
        for _ in range(substeps):
            finer = _extrapolated_step(f, finer, span / substeps)


def reference_flow(
    vector_field: VectorField, q: Tensor, p: Tensor, s: Tensor, h: Tensor | float, max_substeps: int = 128
) -> tuple[Tensor, Tensor, Tensor]:
    """The state of `reference_solve`; raise InputError if the estimated error of a sample exceeds `TOLERANCE`."""
    solution = reference_solve(vector_field, q, p, s, h, max_substeps)
    failed = ~(solution.error <= TOLERANCE)
    if bool(failed.any()):
        sample = int(failed.flatten().nonzero()[0])
        raise InputError(
            f"reference flow: estimated error {float(solution.error.flatten()[sample]):.1e} > {TOLERANCE:.1e} at "
            f"sample {sample} with {max_substeps} substeps; use a smaller h or more substeps"
        )
    return solution.q1, solution.p1, solution.s1


def _extrapolated_step(f: Derivative, x: Tensor, h: Tensor) -> Tensor:
    """One step of order 12, by the Aitken–Neville scheme in the squared step."""
    row: list[Tensor] = []
    for j, first in enumerate(_modified_midpoints(f, x, h)):
        new = [first]
        for k in range(j):
            ratio = (SEQUENCE[j] / SEQUENCE[j - 1 - k]) ** 2
            new.append(new[k] + (new[k] - row[k]) / (ratio - 1.0))
        row = new
    return x + row[-1]


def _modified_midpoints(f: Derivative, x: Tensor, h: Tensor) -> list[Tensor]:
    """Increments of x after every number of leapfrog steps in `SEQUENCE`, which start with an Euler step.

    All columns are one batch, which finished columns leave: f is called 12 times instead of 37.
    """
    counts = torch.tensor(SEQUENCE, dtype=x.dtype, device=x.device)
    d = h / counts.reshape(-1, *(1,) * x.ndim)
    now = d * f(x)
    before, found = torch.zeros_like(now), []
    for k in range(2, SEQUENCE[-1] + 1):
        before, now = now, before + 2.0 * d * f(x + now)
        if k == SEQUENCE[len(found)]:
            found.append(now[0])
            before, now, d = before[1:], now[1:], d[1:]
    return found


Path = Callable[[Tensor], tuple[Tensor, Tensor]]  # (...) t ↦ (q(t), q̇(t)), (..., n) each


def path_action(lagrangian: Lagrangian, path: Path, s0: Tensor, T: Tensor | float) -> Tensor:
    """s(T) of ds/dt = L(q(t), q̇(t), s), s(0) = s0, along a path that need not be a motion; shape (...).

    s(T) − s0 is Herglotz's action of the path. Among the paths with the same ends and the same s0 the action is
    stationary exactly at the solutions of Herglotz's equations, where it equals the exact discrete Lagrangian
    L_d(q(0), q(T), s0). Raise InputError if the integration does not converge.

    Source: Cauchy problem and Herglotz action of the paper.
    """

    def field(t: Tensor, _: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return torch.ones_like(t), torch.zeros_like(t), lagrangian(*path(t[..., 0]), s)

    zero = torch.zeros_like(s0)[..., None]
    return reference_flow(field, zero, zero, s0, T)[2]
