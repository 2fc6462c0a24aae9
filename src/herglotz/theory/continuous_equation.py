"""The continuous equation of a discrete Lagrangian: backward error analysis of its step, without a fit.

The step Φ̃ of L_d at one h is, up to terms that no power of h sees, the time-h flow of a contact vector field X̃. Its
iterates x_j = Φ̃ʲ(x_0) lie on one smooth motion, so X̃ and the motion between them are sums over iterates:

    X̃ = (1/h) log Φ̃ = (1/h) Σ_j w_j x_j,    Φ̃^θ(x_0) = Σ_j ℓ_j(θ) x_j,    j = −m … m,

with the weights of differences of order 2m and of Lagrange's polynomials. Both are the series of backward error
analysis, cut at h^{2m}; m is chosen for every sample where two orders agree best, and their difference is the error
estimate. X̃ is contact because Φ̃ is, and its Hamiltonian needs no integration: H̃ = −η(X̃) = p·q̇ − ṡ, L̃ = ṡ, and
dH̃/dt = −(∂H̃/∂s) H̃.

Sources: M. Vermeeren, A. Bravetti, M. Seri, J. Phys. A 52 (2019) 445206, for contact integrators; S. Ober-Blöbaum,
C. Offen, J. Comput. Appl. Math. 421 (2023) 114780, for learned Lagrangians; P. Moan, Found. Comput. Math. 6 (2006) 261.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import momentum_minus, momentum_plus, partials
from herglotz.mechanics.newton import attached, find_root
from herglotz.mechanics.partials import DiscreteLagrangian, Partials
from herglotz.stepping.method import OneStepMethod
from herglotz.stepping.state import State, Status, Step, check_h, check_state, throw_failure
from herglotz.stepping.stepper import Stepper
from herglotz.theory.continuous import gradient, jacobian
from herglotz.theory.jacobi import join, split

MOST = 9  # largest m: 18 neighbours resolve five samples a period to 1e-6, and fewer gain no digit above rounding
WHOLE = 1e-9  # of a step, that a multiple of h may be off


def inverse_step(L_d: DiscreteLagrangian, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:
    """The step backwards: (q0, p0, s0) with Φ̃(q0, p0, s0) = state, differentiable once.

    FL⁺ is solved for (q0, s0): p1 = D2L_d(q0, q1, s0) + F⁺, s1 = s0 + L_d; then p0 by FL⁻. `c` is that of the step
    forward.

    Parameters
    ----------
    L_d
        The discrete Lagrangian.
    state
        (q1, p1, s1).
    h
        Time step > 0.
    guess
        (..., n + 1) near (q0, s0); default uniform motion at rest, (q1, s1).
    """
    q1, p1, s1 = state
    n = q1.shape[-1]

    def at(y: Tensor, order: int) -> Partials:
        return partials(L_d, y[..., :n], q1, y[..., n], h, order)

    def equation(y: Tensor, P: Partials) -> Tensor:
        return torch.cat([momentum_plus(P) - p1, (y[..., n] + P.L - s1)[..., None]], -1)

    def equations(y: Tensor) -> tuple[Tensor, Tensor]:
        P = at(y, 2)
        slope, by_s = P.D12.mT, P.D23
        if P.force is not None:
            slope, by_s = slope + P.force.plus_1, by_s + P.force.plus_3
        rows = torch.cat([slope, by_s[..., None]], -1)
        return equation(y, P), torch.cat([rows, torch.cat([P.D1, P.c[..., None]], -1)[..., None, :]], -2)

    here = torch.cat([q1, s1[..., None]], -1)
    start = here if guess is None else guess
    root = find_root(equations, start.detach(), scale=(here.abs() + (here - start).abs()).detach())
    y = root.x
    if torch.is_grad_enabled():
        y = attached(y, root.J, equation(y, at(y, 1)))
    P = at(y, 1)
    status = torch.where(root.converged, int(Status.CONVERGED), int(Status.MAX_ITERATIONS)).to(torch.uint8)
    return Step.of(State(y[..., :n], momentum_minus(P), y[..., n]), P.c, status, root.error, root.iterations)


def weights(nodes: Tensor, theta: float) -> tuple[Tensor, Tensor]:
    """Lagrange's weights ℓ_j(θ) and ℓ_j′(θ) over distinct nodes, (K,) each, float64."""
    apart = nodes[:, None] - nodes[None, :]
    below = (apart + torch.eye(len(nodes), dtype=nodes.dtype)).prod(1)
    left = (theta - nodes).expand(len(nodes), -1)
    ones = torch.eye(len(nodes), dtype=torch.bool)
    value = left.masked_fill(ones, 1.0).prod(1) / below
    slope = sum(
        left.masked_fill(ones | (torch.arange(len(nodes)) == i), 1.0).prod(1) * ~ones[i] for i in range(len(nodes))
    )
    return value, slope / below  # type: ignore[operator]


@dataclass(frozen=True)
class ContinuousEquation:
    """X̃, H̃ and L̃ of a discrete Lagrangian at one step, and its motion between the steps.

    With forces the step is no contact map: X̃ and the motion stand, H̃ = p·q̇ − ṡ is the energy, and dH̃/dt has the power
    of the forces, too.

    Parameters
    ----------
    L_d
        The discrete Lagrangian; of a driven one, `L_d.at(u)`.
    h
        The step at which it was learned, or is to be understood.
    order
        2m, even; None: chosen for every sample. Order 2m is the series in h cut after h^{2m}.
    """

    L_d: DiscreteLagrangian
    h: float
    order: int | None = None

    def __post_init__(self) -> None:
        if not self.h > 0:
            raise InputError(f"h must be > 0, got {self.h}")
        if self.order is not None and (self.order % 2 or not 2 <= self.order <= 2 * MOST):
            raise InputError(f"order must be even, from 2 to {2 * MOST}, got {self.order}")

    def field(self, q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """X̃: (q̇, ṗ, ṡ), shapes (..., n), (..., n), (...); NaN where a step that is needed fails."""
        X, _, _ = self._sum(State(q, p, s), 0.0, 1)
        return split(X[..., :-1] / self.h)

    def hamiltonian(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """H̃(q, p, s) = p·q̇ − ṡ, shape (...): the energy; in units of p·v."""
        q_dot, _, s_dot = self.field(q, p, s)
        return (p * q_dot).sum(-1) - s_dot

    def damping(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """R(H̃) = ∂H̃/∂s, shape (...): H̃ and the contact form shrink at this rate."""
        return gradient(lambda s: self.hamiltonian(q, p, s[..., 0]), s[..., None])[1][..., 0]

    def momentum(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        """P with q̇ = v, shape (..., n), without a graph; NaN where Newton's iteration finds none."""

        def equations(p: Tensor) -> tuple[Tensor, Tensor]:
            q_dot, J = jacobian(lambda p: self.field(q, p, s)[0], p)
            return q_dot - v, J

        return find_root(equations, momentum_plus(partials(self.L_d, q - self.h * v, q, s, self.h))).solved

    def lagrangian(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        """L̃(q, v, s) = ṡ at the momentum of v, shape (...): the modified contact Lagrangian; without a graph."""
        return self.field(q, self.momentum(q, v, s), s)[2]

    def error(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """The estimated error of X̃, (...), relative to the move to the next iterate: two orders differ by so much."""
        return self._sum(State(q, p, s), 0.0, 1)[1]

    def between(self, state: State, theta: float) -> tuple[State, Tensor, Tensor]:
        """Φ̃^θ(state) for 0 ≤ θ ≤ 1, its conformal factor, and the estimated error."""
        x, error, _ = self._sum(state, theta, 0)
        return State(*split(x[..., :-1])), x[..., -1].exp(), error

    @cached_property
    def _stepper(self) -> Stepper:
        return Stepper(self.L_d)

    def _sum(self, state: State, theta: float, derivative: int) -> tuple[Tensor, Tensor, Tensor]:
        """Σ weights · (q, p, s, ln σ), (..., 2n+2), the error estimate (...) and m (...)."""
        most = MOST if self.order is None else self.order // 2
        x, sound = self._iterates(state, most)
        found, centre = [], x[..., most, :]
        for m in range(1, most + 1):
            nodes = torch.arange(-m, m + 1, dtype=torch.float64)
            w = weights(nodes, theta)[derivative].to(x)
            # differences to the centre: their sum with weights that add up to 0 or 1 loses no digits to it
            apart = x[..., most - m : most + m + 1, :] - centre[..., None, :]
            total = (w[:, None] * apart).sum(-2) + (centre if derivative == 0 else 0.0)
            whole = sound[..., most - m : most + m + 1].all(-1)
            found.append(torch.where(whole[..., None], total, torch.nan))
        values = torch.stack(found)
        size = (x[..., most + 1, :] - centre).abs().detach()
        size = torch.where(size.isfinite(), size, 0.0)
        size = size + 1e-3 * size.amax(-1, keepdim=True)
        change = ((values[1:] - values[:-1]).abs() / torch.where(size > 0, size, 1.0)).amax(-1).detach()
        change = torch.cat(
            [
                torch.full_like(change[:1], torch.inf)
                if len(change)
                else values.new_full((1, *x.shape[:-2]), torch.inf),
                change,
            ]
        )
        change = change.nan_to_num(torch.inf)
        best = change.argmin(0) if self.order is None else torch.full(x.shape[:-2], most - 1, device=x.device)
        pick = best[None, ..., None].expand(1, *values.shape[1:])
        return values.gather(0, pick)[0], change.gather(0, best[None])[0], best + 1

    def _iterates(self, state: State, most: int) -> tuple[Tensor, Tensor]:
        """x_{−m} … x_m with ln σ_j (σ_0 = 1), (..., 2m+1, 2n+2), and which of them exist."""
        state = State(*check_state(state))
        zero = torch.zeros_like(state.s)
        points, sound = [_with(state, zero)], [torch.ones_like(state.s, dtype=torch.bool)]
        now, log_c, good = state, zero, sound[0]
        for _ in range(most):
            step = self._stepper.step(now, self.h)
            now, log_c = step.state, log_c + step.c.log()
            good = good & (step.status == Status.CONVERGED)
            points.append(_with(now, log_c))
            sound.append(good)
        first, log_c, good, now = points[1].detach(), zero, sound[0], state
        n = state.q.shape[-1]
        guess = 2 * points[0].detach() - first  # uniform motion backwards
        for _ in range(most):
            start = torch.cat([guess[..., :n], guess[..., 2 * n : 2 * n + 1]], -1)
            step = inverse_step(self.L_d, now, self.h, torch.where(start.isfinite(), start, 0.0))
            now, log_c = step.state, log_c - step.c.log()
            good = good & (step.status == Status.CONVERGED)
            points.insert(0, _with(now, log_c))
            sound.insert(0, good)
            guess = 2 * points[0].detach() - points[1].detach()
        return torch.stack(points, -2), torch.stack(sound, -1)


class FractionalStepper(OneStepMethod):
    """Steps of any length along the motion of a `ContinuousEquation`: whole steps of its L_d, then a part of one.

    A multiple of the equation's h costs its steps; another h the steps of both neighbourhoods, 2·9 and more. The status
    is `UNRESOLVED` where two orders differ by more than `tolerance`, relative to a step.
    """

    def __init__(self, equation: ContinuousEquation, *, tolerance: float = 1e-6, throw: bool = False):
        self.equation, self.tolerance, self.throw = equation, tolerance, throw

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:  # noqa: ARG002  nothing to guess
        """One step of a scalar h > 0."""
        state = check_state(state)
        size = check_h(h, state.q)
        if size.ndim:
            raise InputError(f"a step at another h than the model's needs a scalar h, got shape {tuple(size.shape)}")
        whole, theta = _parts(float(size) / self.equation.h)
        now, c = state, torch.ones_like(state.s)
        status, residual = torch.zeros_like(state.s, dtype=torch.uint8), torch.zeros_like(state.s)
        for _ in range(whole):
            part = self.equation._stepper.step(now, self.equation.h)
            now, c = part.state, c * part.c
            status = torch.where(status == Status.CONVERGED, part.status, status)
            residual = torch.maximum(residual, part.residual)
        if theta:
            now, more, error = self.equation.between(now, theta)
            c, residual = c * more, torch.maximum(residual, error)
            lost = ~(error <= self.tolerance) & (status == Status.CONVERGED)
            status = torch.where(lost, torch.full_like(status, Status.UNRESOLVED), status)
        if self.throw:
            throw_failure(status, residual)
        return Step.of(now, c, status, residual, 0)


def _parts(ratio: float) -> tuple[int, float]:
    """The whole steps of a ratio, and the rest, 0 where it is a multiple."""
    whole = round(ratio)
    if abs(ratio - whole) <= WHOLE * max(ratio, 1.0) and whole > 0:
        return whole, 0.0
    whole = int(ratio)
    return whole, ratio - whole


def _with(state: State, log_c: Tensor) -> Tensor:
    return torch.cat([join(*state), log_c[..., None]], -1)
