"""The continuous equation of a discrete Lagrangian: backward error analysis of the step, without a fit.

The step Φ̃ of L_d at one h is the time-h flow of a contact vector field X̃, up to terms smaller than any power of h. The
iterates x_j = Φ̃ʲ(x_0) lie on one smooth motion, so X̃ and the motion between the iterates are sums over iterates:

    X̃ = (1/h) log Φ̃ = (1/h) Σ_j w_j x_j,    Φ̃^θ(x_0) = Σ_j ℓ_j(θ) x_j,    j = −m … m,

with the weights w_j of differences of order 2m and ℓ_j of Lagrange's polynomials. Both are the series of backward error
analysis, truncated at h^{2m}. m is the order at which two orders agree best in a sample, and their difference is the
error estimate. The series is asymptotic. If Φ̃ is not integrable, an error exponentially small in 1/h remains for every
m (Hénon–Heiles at 12 samples a period: 4e-6 with m = 18 and with m = 28). X̃ is contact because Φ̃ is contact, and the
Hamiltonian needs no integration: H̃ = −η(X̃) = p·q̇ − ṡ, L̃ = ṡ, and dH̃/dt = −(∂H̃/∂s) H̃.

Sources: M. Vermeeren, A. Bravetti, M. Seri, J. Phys. A 52 (2019) 445206, for contact integrators; S. Ober-Blöbaum,
C. Offen, J. Comput. Appl. Math. 421 (2023) 114780, for learned Lagrangians; P. Moan, Found. Comput. Math. 6 (2006) 261.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import momentum_minus, momentum_plus, partials
from herglotz.mechanics.contact import jacobian, join, split
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, gradient
from herglotz.stepping.rollout import OneStepMethod
from herglotz.stepping.state import State, Status, Step, check_h, check_state
from herglotz.stepping.stepper import Stepper

# Largest m. At 31 samples a period of Hénon–Heiles, 9 leaves dH̃/dt + RH̃ = 4e-9 and 18 leaves 1e-11.
MAX_NEIGHBOURS = 18
# Two orders whose difference is below this share of the move to the next iterate differ by rounding.
ROUNDING = 1e-13
# A time within this share of a multiple of h is that multiple.
MULTIPLE_TOLERANCE = 1e-9


def inverse_step(L_d: DiscreteLagrangian, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:
    """The inverse step: (q0, p0, s0) with Φ̃(q0, p0, s0) = state = (q1, p1, s1), once differentiable.

    Newton's method inverts FL⁺, p1 = D2L_d(q0, q1, s0) + F⁺ and s1 = s0 + L_d, for (q0, s0); FL⁻ gives p0. `c` is the
    factor of the forward step. `guess`, (..., n + 1), is near (q0, s0), by default (q1, s1).
    """
    q1, p1, s1 = state
    n = q1.shape[-1]

    def at(y: Tensor) -> Partials:
        return partials(L_d, y[..., :n], q1, y[..., n], h)

    def missed(y: Tensor) -> Tensor:
        P = at(y)
        return torch.cat([momentum_plus(P) - p1, (y[..., n] + P.L - s1)[..., None]], -1)

    here = torch.cat([q1, s1[..., None]], -1)
    start = here if guess is None else guess
    scale = (here.abs() + (here - start).abs()).detach()
    root = find_root(lambda y: jacobian(missed, y), start.detach(), scale)
    y = root.with_slope(missed)
    P = at(y)
    status = torch.where(root.converged, int(Status.CONVERGED), int(Status.MAX_ITERATIONS)).to(torch.uint8)
    return Step.of(State(y[..., :n], momentum_minus(P), y[..., n]), P.c, status, root.error, root.iterations)


def weights(nodes: Tensor, theta: float) -> tuple[Tensor, Tensor]:
    """Lagrange's weights ℓ_j(θ) and ℓ_j′(θ) over distinct nodes, (K,) each, float64."""
    distances = nodes[:, None] - nodes[None, :]
    below = (distances + torch.eye(len(nodes), dtype=nodes.dtype)).prod(1)
    left = (theta - nodes).expand(len(nodes), -1)
    ones = torch.eye(len(nodes), dtype=torch.bool)
    value = left.masked_fill(ones, 1.0).prod(1) / below
    slope = sum(
        left.masked_fill(ones | (torch.arange(len(nodes)) == i), 1.0).prod(1) * ~ones[i] for i in range(len(nodes))
    )
    return value, slope / below  # type: ignore[operator]


@dataclass(frozen=True)
class ContinuousEquation:
    """X̃, H̃ and L̃ of a discrete Lagrangian at a step h, and the motion between the steps.

    With forces the step is no contact map. X̃ and the motion remain valid, H̃ = p·q̇ − ṡ is the energy, and dH̃/dt also has
    the power of the forces.

    Parameters
    ----------
    L_d
        The discrete Lagrangian; of a driven one, `L_d.at(u)`.
    h
        The step at which L_d was learned, or at which its motion is wanted.
    order
        2m, even: the series in h is truncated after h^{2m}. None chooses the order of every sample.
    """

    L_d: DiscreteLagrangian
    h: float
    order: int | None = None

    def __post_init__(self) -> None:
        if not self.h > 0:
            raise InputError(f"h must be > 0, got {self.h}")
        if self.order is not None and (self.order % 2 or not 2 <= self.order <= 2 * MAX_NEIGHBOURS):
            raise InputError(f"order must be even, from 2 to {2 * MAX_NEIGHBOURS}, got {self.order}")

    def field(self, q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """X̃ = (q̇, ṗ, ṡ), shapes (..., n), (..., n), (...); NaN where a step fails."""
        X, _ = self._slope(q, p, s)
        return split(X[..., :-1] / self.h)

    def hamiltonian(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """The energy H̃(q, p, s) = p·q̇ − ṡ, shape (...), in units of p·v."""
        q_dot, _, s_dot = self.field(q, p, s)
        return (p * q_dot).sum(-1) - s_dot

    def damping(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """R(H̃) = ∂H̃/∂s, shape (...): the rate at which H̃ and the contact form shrink."""
        return gradient(lambda s: self.hamiltonian(q, p, s[..., 0]), s[..., None])[1][..., 0]

    def momentum(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        """The momentum p with q̇ = v, shape (..., n), without a graph; NaN where Newton's method finds no p."""

        def missed(p: Tensor) -> Tensor:
            return self.field(q, p, s)[0] - v

        return find_root(
            lambda p: jacobian(missed, p), momentum_plus(partials(self.L_d, q - self.h * v, q, s, self.h))
        ).solved

    def lagrangian(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        """The modified contact Lagrangian L̃(q, v, s) = ṡ at the momentum of v, shape (...), without a graph."""
        return self.field(q, self.momentum(q, v, s), s)[2]

    def error(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """The error estimate of X̃, (...): the difference of two orders, relative to the move to the next iterate."""
        return self._slope(q, p, s)[1]

    def _slope(self, q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """The first derivative of the interpolated iterates at the state, per step, and its error estimate."""
        return _summed(_Iterates(self, State(q, p, s)), 0, 0.0, 1)


class _Iterates:
    """The iterates x_j of a state with ln σ_j, (..., 2n+2), j of either sign, computed on demand."""

    def __init__(self, equation: ContinuousEquation, state: State):
        state = State(*check_state(state))
        self.L_d, self.h, self.stepper = equation.L_d, equation.h, Stepper(equation.L_d)
        self.most, self.fixed = (MAX_NEIGHBOURS, False) if equation.order is None else (equation.order // 2, True)
        first = torch.cat([join(*state), torch.zeros_like(state.s)[..., None]], -1)
        self.nodes = {0: (first, torch.zeros_like(state.s, dtype=torch.uint8))}

    def node(self, j: int) -> tuple[Tensor, Tensor]:
        """x_j and the status of the steps from x_0 to x_j."""
        while j > max(self.nodes):
            self._add(max(self.nodes), 1)
        while j < min(self.nodes):
            self._add(min(self.nodes), -1)
        return self.nodes[j]

    def forget(self, before: int) -> None:
        """Drop the iterates before a node."""
        self.nodes = {j: x for j, x in self.nodes.items() if j >= before}

    def _add(self, last: int, sign: int) -> None:
        x, status = self.nodes[last]
        state, log_c = State(*split(x[..., :-1])), x[..., -1]
        n = state.q.shape[-1]
        other = self.nodes.get(last - sign)
        guess, forward = None, sign > 0
        if other is not None:
            uniform = (2 * x - other[0]).detach()
            uniform = torch.where(uniform.isfinite(), uniform, x)
            q, s = uniform[..., :n], uniform[..., 2 * n : 2 * n + 1]
            guess = q if forward else torch.cat([q, s], -1)
        step = self.stepper.step(state, self.h, guess) if forward else inverse_step(self.L_d, state, self.h, guess)
        row = torch.cat([join(*step.state), (log_c + sign * step.c.log())[..., None]], -1)
        self.nodes[last + sign] = (row, torch.where(status == Status.CONVERGED, step.status, status))


def _summed(iterates: _Iterates, centre: int, theta: float, derivative: int) -> tuple[Tensor, Tensor]:
    """Σ weights · (q, p, s, ln σ) at centre + θ, (..., 2n+2), and the error estimate (...).

    Neighbours are added until two orders agree to rounding in every sample, or `most` neighbours stand on each side.
    """
    middle, found = iterates.node(centre)[0], []
    size = (iterates.node(centre + 1)[0] - middle).abs().detach()
    size = torch.where(size.isfinite(), size, 0.0)
    size = size + 1e-3 * size.amax(-1, keepdim=True)
    size = torch.where(size > 0, size, 1.0)
    change = [torch.full_like(middle[..., 0], torch.inf)]
    for m in range(1, iterates.most + 1):
        window = [iterates.node(j) for j in range(centre - m, centre + m + 1)]
        w = weights(torch.arange(-m, m + 1, dtype=torch.float64), theta)[derivative].tolist()
        # The weights add up to 0 or 1. Summing differences to the centre avoids cancellation.
        total = sum(weight * (x - middle) for weight, (x, _) in zip(w, window, strict=True))
        sound = torch.stack([status == Status.CONVERGED for _, status in window]).all(0)
        total = total + (middle if derivative == 0 else 0.0)
        found.append(torch.where(sound[..., None], total, torch.nan))
        if m > 1:
            change.append(((found[-1] - found[-2]).abs() / size).amax(-1).detach().nan_to_num(torch.inf))
            if not iterates.fixed and bool((torch.stack(change).amin(0) <= ROUNDING).all()):
                break
    values, differences = torch.stack(found), torch.stack(change)
    best = differences.argmin(0)
    if iterates.fixed:
        best = torch.full_like(best, len(found) - 1)
    pick = best[None, ..., None].expand(1, *values.shape[1:])
    return values.gather(0, pick)[0], differences.gather(0, best[None])[0]


class FractionalStepper(OneStepMethod):
    """Steps of any length along the motion of a `ContinuousEquation`: whole steps of L_d, and fractions of a step.

    A rollout keeps the iterates of its start: the cost is one whole step for each h of the duration, up to
    `MAX_NEIGHBOURS` more on each side, and the sums. The status is `UNRESOLVED` where two orders differ by more than
    `tolerance`, relative to a whole step.
    """

    def __init__(self, equation: ContinuousEquation, *, tolerance: float = 1e-6):
        self.equation, self.tolerance = equation, tolerance
        # The last q with its motion, time and ln σ: the next step of a rollout continues them.
        self._last: tuple[Tensor, _Iterates, float, Tensor] | None = None

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:  # noqa: ARG002
        """One step of a scalar h > 0; `guess` is not used."""
        state = check_state(state)
        size = check_h(h, state.q)
        if size.ndim:
            raise InputError(f"a step at another h than the model's needs a scalar h, got shape {tuple(size.shape)}")
        last = self._last
        if last is None or last[0] is not state.q:
            last = (state.q, _Iterates(self.equation, state), 0.0, torch.zeros_like(state.s))
        _, iterates, time, log_c = last
        time = time + float(size) / self.equation.h
        whole, theta = _parts(time)
        x, status = iterates.node(whole)
        error = torch.zeros_like(state.s)
        if theta:
            x, error = _summed(iterates, whole, theta, 0)
            lost = ~(error <= self.tolerance) & (status == Status.CONVERGED)
            status = torch.where(lost, torch.full_like(status, Status.UNRESOLVED), status)
        iterates.forget(whole - iterates.most)
        step = Step.of(State(*split(x[..., :-1])), (x[..., -1] - log_c).exp(), status, error, 0)
        self._last = (step.state.q, iterates, time, x[..., -1])
        return step


def _parts(time: float) -> tuple[int, float]:
    """The whole steps of a time in units of h, and the rest, 0 for a multiple."""
    whole = round(time)
    if abs(time - whole) <= MULTIPLE_TOLERANCE * max(time, 1.0):
        return whole, 0.0
    return int(time), time - int(time)
