"""The derivative of a step, by the implicit-function theorem on the solved step equation.

A step solves F(Δ; q0, p0, s0, h, u) = 0 and returns q1 = q0 + Δ, p1 and s1 = s0 + L, all functions of Δ and of the
arguments w = (q0, p0, s0, h, u) of the step. Hence

    dΔ/dw = −F_Δ⁻¹ F_w,    dp1/dw = p1_w + p1_Δ dΔ/dw,    ds1/dw = ds0/dw + L_w + L_Δ dΔ/dw.

The partial derivatives of F, p1 and L are automatic derivatives of the first-order step equation, in forward mode for a
model, so that no model needs code of its own.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian
from herglotz.mechanics.contact import jacobian, join
from herglotz.models import ContactLagrangian
from herglotz.models.numbers import WithNumbers, chosen, values_of
from herglotz.stepping.equation import PartialsEquation, model_equation
from herglotz.stepping.single_step import driven_by
from herglotz.stepping.state import State, Step

# (q0, p0, s0, h, Δ, u[, θ]) → F (..., n), p1 (..., n), L (...)
StepFunctions = Callable[..., tuple[Tensor, Tensor, Tensor]]
Slopes = Callable[[Callable[[Tensor], Tensor], Tensor], Tensor]


class Linearised(NamedTuple):
    """A step and its derivatives; rows are (q, p, s) after the step. NaN where the step failed."""

    step: Step
    by_state: Tensor  # (..., 2n+1, 2n+1) d(q, p, s)′ / d(q, p, s)
    by_h: Tensor  # (..., 2n+1)
    by_input: Tensor | None  # (..., 2n+1, m), where the step has an input
    by_parameters: Tensor | None = None  # (..., 2n+1, K), where numbers of the model were named


def linearise(
    L_d: DiscreteLagrangian, state: State, h: Tensor, u: Tensor | None, step: Step, numbers: Sequence[str] = ()
) -> Linearised:
    """The derivatives of a solved step of L_d from `state`; h is a scalar or (...), u is (m,) or (..., m).

    `numbers` names K numbers of a model, as `chosen` reads names, for the derivatives by these numbers. Raise
    InputError if L_d is no model with such numbers.
    """
    functions, theta = step_functions(L_d), None
    if numbers:
        if not isinstance(L_d, ContactLagrangian):
            raise InputError(f"parameters are numbers of a model, and {type(L_d).__name__} is none; leave them out")
        names = chosen(L_d, numbers)
        theta = state.q.new_tensor(values_of(L_d, names))
        functions = WithNumbers(L_d, functions, names).at
    q, p, s = (x.detach() for x in state)
    h = h.detach().expand(s.shape)
    u = None if u is None else u.detach().expand(*s.shape, u.shape[-1])
    delta = step.state.q.detach() - q
    # In reverse mode, row by row, where L_d itself may be differentiated by autograd.
    slopes = forward_slopes if isinstance(L_d, ContactLagrangian) else lambda values, x: jacobian(values, x)[1]
    with torch.no_grad():
        J = step_jacobian(functions, State(q, p, s), h, delta, u, slopes, theta)
    size, m = 2 * q.shape[-1] + 1, 0 if u is None else u.shape[-1]
    by_input, by_parameters = J[..., size + 1 : size + 1 + m], J[..., size + 1 + m :]
    return Linearised(
        step, J[..., :size], J[..., size], None if u is None else by_input, by_parameters if numbers else None
    )


def step_functions(L_d: DiscreteLagrangian) -> StepFunctions:
    """F, p1 and L of L_d as a pure function of tensors: by the terms of a model where known, else by jets."""

    def functions(
        q: Tensor, p: Tensor, s: Tensor, h: Tensor, delta: Tensor, u: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        state, maker = State(q, p, s), model_equation(L_d, fold=False)
        if maker is not None:
            form = maker.at(state, h, u, True)
            x = delta
        else:
            increments = hasattr(L_d, "partials_increment")
            form = PartialsEquation(driven_by(L_d, u), state, h, 1, increments)
            x = delta if increments else q + delta
        point = form(x, False)
        end, F = form.end(x, point), point.F
        if isinstance(form, PartialsEquation) and point.rest.force is not None and point.rest.force.held is not None:
            # A sticking coordinate has Δ = 0.
            F = torch.where(point.rest.force.held > 0, delta, F)
        return F, end.p1, end.L

    return functions


def step_jacobian(
    functions: StepFunctions,
    state: State,  # (..., n), (..., n), (...)
    h: Tensor,  # (...)
    delta: Tensor,  # (..., n) the solution of F = 0
    u: Tensor | None,  # (..., m)
    slopes: Slopes | None = None,
    theta: Tensor | None = None,  # (K,) shared by all samples: the last argument of `functions`
) -> Tensor:
    """d(q, p, s)′ / d(q, p, s, h, u, θ) at a solved step, (..., 2n+1, 2n+2+m+K): a pure function of tensors.

    `slopes` differentiates; default `forward_slopes`.
    """
    q, p, s = state
    n = q.shape[-1]
    sizes = [n, n, 1, 1, *(() if u is None else (u.shape[-1],)), n]
    point = torch.cat([q, p, s[..., None], h[..., None], *(() if u is None else (u,)), delta], -1)

    def values(z: Tensor, *theta: Tensor) -> Tensor:
        q, p, s, h, *u, delta = z.split(sizes, -1)
        F, p1, L = functions(q, p, s[..., 0], h[..., 0], delta, u[0] if u else None, *theta)
        return join(F, p1, L)

    at = values if theta is None else lambda z: values(z, theta)
    rows = (slopes or forward_slopes)(at, point)  # (..., 2n+1, 3n+2+m) of F, p1 and L
    by_start, by_delta = rows[..., :-n], rows[..., -n:]
    if theta is not None:
        by_start = torch.cat([by_start, forward_slopes(values, point, theta)], -1)
    ddelta = -eliminate(by_delta[..., :n, :], by_start[..., :n, :])
    ends = by_start[..., n:, :] + by_delta[..., n:, :] @ ddelta
    # The derivative of (q, p, s) itself.
    start = torch.eye(2 * n + 1, by_start.shape[-1], dtype=q.dtype, device=q.device)
    return torch.cat([ddelta + start[:n], ends[..., :n, :], ends[..., n:, :] + start[2 * n :]], -2)


def step_pull(
    functions: StepFunctions,
    state: State,  # (..., n), (..., n), (...)
    h: Tensor,  # (...)
    delta: Tensor,  # (..., n) the solution of F = 0
    u: Tensor | None,  # (..., m)
    after: Tensor,  # (..., 2n+1) derivatives of a scalar by (q, p, s) after the step
    theta: Tensor | None = None,  # (K,) shared by all samples: the last argument of `functions`
) -> tuple[Tensor, Tensor | None]:
    """The derivatives of the scalar by (q, p, s, h, u), (..., 2n+2+m), and by θ, (K,) summed over samples.

    They are `step_jacobian`ᵀ `after`, in reverse mode: with r = ∂/∂q1 + p1_Δᵀ ∂/∂p1 + L_Δ ∂/∂s1 and F_Δᵀ λ = r, they
    are the derivatives of p1ᵀ∂/∂p1 + L ∂/∂s1 − Fᵀλ.
    """
    q, p, s = state
    n, more = q.shape[-1], () if theta is None else (theta,)
    by_q, by_p, by_s = after[..., :n], after[..., n : 2 * n], after[..., 2 * n]

    def values(q: Tensor, p: Tensor, s: Tensor, h: Tensor, delta: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        return functions(q, p, s, h, delta, None if u is None else rest[0], *rest[u is not None :])

    arguments = (q, p, s, h, delta, *(() if u is None else (u,)), *more)
    pull = torch.func.vjp(values, *arguments)[1]
    r = by_q + pull((torch.zeros_like(q), by_p, by_s))[4]
    rest = arguments[5:]
    F_delta = forward_slopes(lambda *x: values(*x[:4], x[-1], *x[4:-1])[0], q, p, s, h, *rest, delta)
    lam = eliminate(F_delta.mT, r[..., None])[..., 0]
    found = pull((-lam, by_p, by_s))
    inputs = () if u is None else (found[5],)
    rows = [found[0] + by_q, found[1], (found[2] + by_s)[..., None], found[3][..., None], *inputs]
    return torch.cat(rows, -1), None if theta is None else found[-1]


def forward_slopes(values: Callable[..., Tensor], *points: Tensor) -> Tensor:
    """The Jacobian (..., m, k) of `values`(..., x) → (..., m) by its last point, (..., k) or (k,), in forward mode."""
    *first, point = points
    directions = torch.eye(point.shape[-1], dtype=point.dtype, device=point.device)
    # torch 2.x ends the process in `addcmul` if a single argument has a tangent: the other arguments get zero tangents.
    still = [torch.zeros_like(x) for x in first]
    along = lambda t: torch.func.jvp(values, points, (*still, t.expand_as(point)))[1]  # noqa: E731
    # torch itself uses torch.jit when forward-mode derivatives are first loaded.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`torch.jit.script` is", DeprecationWarning)
        return torch.func.vmap(along)(directions).movedim(0, -1)


def eliminate(A: Tensor, b: Tensor) -> Tensor:
    """A⁻¹ b by elimination with row exchanges, written out: ONNX has no solve, and AOTInductor's is slow.

    A is (..., n, n), with a small n, and b (..., n, k); inf or nan where A is singular.
    """
    n = b.shape[-2]
    if n == 1:
        return b / A
    if n == 2:
        # Cramer's rule: half of the operations.
        (a, c), (d, e) = ((A[..., i, :1], A[..., i, 1:]) for i in range(2))
        (f, g), rate = b.unbind(-2), 1 / (a * e - c * d)
        return torch.stack([(e * f - c * g) * rate, (a * g - d * f) * rate], -2)
    rows = [torch.cat([A[..., i, :], b[..., i, :]], -1) for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            swap = (rows[i][..., k].abs() > rows[k][..., k].abs())[..., None]
            rows[k], rows[i] = torch.where(swap, rows[i], rows[k]), torch.where(swap, rows[k], rows[i])
        for i in range(k + 1, n):
            rows[i] = rows[i] - (rows[i][..., k] / rows[k][..., k])[..., None] * rows[k]
    x: list[Tensor] = []
    for i in reversed(range(n)):
        value = rows[i][..., n:]
        for j, known in zip(range(n - 1, i, -1), x, strict=True):
            value = value - rows[i][..., j : j + 1] * known
        x.append(value / rows[i][..., i : i + 1])
    return torch.stack(x[::-1], -2)
