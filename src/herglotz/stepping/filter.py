"""An extended Kalman filter on the step of a model: measured positions in; state, velocity and covariance out.

`export/runtime/filter.h` does the same operations in C. The filter's state x is (q, p), s if the motion depends on s,
and chosen numbers θ of the model as slow states. Over a step h whose derivative by x is A, forces that the model does
not have add w²h to the variance of p, half before the step and half after,

    P ← A (P + W/2) Aᵀ + W/2,        W = diag(0, w² h, 0, w_θ² h),

so that q and p are correlated. The update uses the components of y = q + e one by one, as those of e are independent:

    S = P_ii + σ_i²,    x ← x + P_i (y_i − q_i)/S,    P ← P − P_i P_iᵀ/S.

The error of a model differs from motion to motion: the common scale κ of all variances is learned,

    w ← (1 − a) w + 1,    κ ← κ + (r − 1) κ/w,        r = Σ (y_i − q_i)²/(κ S_i n),

which changes no estimate (a = 0: κ is not learned). A fixed-lag smoother is the same filter of a longer state: x and
copies of x at the last samples. A step does not change the copies, and an update moves them by their covariance with q.
`export/runtime/filter.h` keeps only the blocks of P that change.

Source: A. Gelb (ed.), Applied optimal estimation (1974), sections 4.2 and 6.1; B. D. O. Anderson & J. B. Moore, Optimal
filtering (1979), section 7.3; M. West & J. Harrison, Bayesian forecasting and dynamic models (1997), section 10.8.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.models.numbers import chosen, values_of, with_values
from herglotz.stepping.linearise import Linearised
from herglotz.stepping.state import State, Status
from herglotz.stepping.stepper import Stepper


class Noise(NamedTuple):
    """Standard deviations in the units of q, and of p and θ a root of time: variances of p and θ grow with time."""

    position: Sequence[float]  # (n,) of a measured position
    momentum: Sequence[float]  # (n,) of the change of p by unknown forces
    theta: Sequence[float] = ()  # (K,) of the drift of the numbers
    # a of the common scale κ, an average over 1/a updates; 0: variances are as given.
    adaptation: float = 0.0


class Belief(NamedTuple):
    """The estimate of a filter at a time."""

    state: State  # (n,), (n,), ()
    theta: Tensor  # (K,)
    # (F, F) of q, p, s if the motion depends on s, and θ, over the scale; (F + FL, F + FL) with earlier samples
    covariance: Tensor
    earlier: Tensor | None = None  # (L, F) the same numbers at the earlier samples, the newest first
    scale: Tensor | float = 1.0  # () or (B,) κ, of all variances
    # w, the number of updates behind the scale.
    weight: float = 1.0


class KalmanFilter:
    """The filter of a model, with the noise and the estimated numbers θ.

    Parameters
    ----------
    model
        Not changed.
    noise
        Standard deviations.
    parameters
        Names of numbers of the model that are estimated too, as `chosen` reads names.
    bounds
        (low, high) of some parameters, by name; the estimates stay within.
    stepper
        An `ExportedStepper` of the model with `with_parameters`; by default the model is stepped by `Stepper`.
    """

    def __init__(
        self,
        model: ContactLagrangian,
        noise: Noise,
        parameters: Sequence[str] = (),
        bounds: Mapping[str, tuple[float | None, float | None]] | None = None,
        stepper: Any = None,
    ):
        self.stepper = stepper
        self.model, self.noise, self.n = model, noise, model.dof
        self.names = chosen(model, parameters)
        # Sizes of q, p[, s] in the filter's state, and F of the whole state.
        self.kept = 2 * self.n + model.s_enters_motion
        self.size = self.kept + len(self.names)
        sizes = {"position": self.n, "momentum": self.n, "theta": len(self.names)}
        for name, size in sizes.items():
            row = getattr(noise, name)
            low = 0.0 if name != "position" else math.ulp(0.0)
            if len(row) != size or not all(low <= x < math.inf for x in row):
                raise InputError(f"noise.{name} needs {size} finite standard deviations, got {list(row)}")
        if not 0 <= noise.adaptation < 1:
            raise InputError(f"noise.adaptation must be at least 0 and below 1, got {noise.adaptation:g}")
        own = bounds or {}
        span = [own.get(name, (None, None)) for name in self.names]
        self.low = torch.tensor([-math.inf if a is None else a for a, _ in span], dtype=torch.float64)
        self.high = torch.tensor([math.inf if b is None else b for _, b in span], dtype=torch.float64)

    def start(self, state: State, std: Tensor, theta: Tensor | None = None) -> Belief:
        """A belief at a state, (n,), (n,), (), with standard deviations (F,); θ is by default that of the model."""
        size = self.size
        if std.shape != (size,) or not bool((std.isfinite() & (std >= 0)).all()):
            raise InputError(f"std needs {size} finite standard deviations of q, p[, s] and θ, got {std.tolist()}")
        theta = std.new_tensor(values_of(self.model, self.names)) if theta is None else theta
        return Belief(state, theta, torch.diag(std.square()))

    def predict(self, belief: Belief, h: float, u: Tensor | None = None) -> Belief:
        """The belief after a step h with the input u (m,).

        Raise InputError if the model has no step there.
        """
        found = self._stepped(belief, h, u)
        kept, size, P = self.kept, self.size, belief.covariance
        A = torch.eye(len(P), dtype=P.dtype)
        A[:kept, :kept] = found.by_state[:kept, :kept]
        if found.by_parameters is not None:
            A[:kept, kept:size] = found.by_parameters[:kept]
        W = P.new_zeros(len(P))
        W[self.n : 2 * self.n] = P.new_tensor(self.noise.momentum).square() * (h / 2)
        W[kept:size] = P.new_tensor(self.noise.theta).square() * (h / 2)
        P = A @ (P + torch.diag(W)) @ A.T
        return belief._replace(state=found.step.state, covariance=(P + P.T) / 2 + torch.diag(W))

    def remember(self, belief: Belief, lag: int) -> Belief:
        """The belief with the present sample added to the earlier samples, of which the last `lag` are kept."""
        now, size = self._row(belief)[None], self.size
        earlier = now if belief.earlier is None else torch.cat([now, belief.earlier])[:lag]
        every = torch.arange(len(belief.covariance))
        places = torch.cat([every[:size], every])[: size * (1 + len(earlier))]
        return belief._replace(earlier=earlier, covariance=belief.covariance[places][:, places])

    def smoothed(self, belief: Belief, back: int) -> Belief:
        """The belief about the sample that lies `back` samples before the last.

        If the motion does not depend on s, s is that of the belief. Raise InputError if fewer samples are remembered.
        """
        count = 0 if belief.earlier is None else len(belief.earlier)
        if not 0 <= back <= count:
            raise InputError(f"back must be 0 to {count}, the samples that are remembered, got {back}")
        own = slice(back * self.size, (back + 1) * self.size)
        x = self._row(belief) if belief.earlier is None or not back else belief.earlier[back - 1]
        return Belief(*self._parts(x, belief.state.s), belief.covariance[own, own], scale=belief.scale)

    def update(self, belief: Belief, y: Tensor) -> tuple[Belief, float]:
        """The belief after measured positions y (n,), and the sum of squared innovations over their variances.

        Angles count modulo a turn; θ stays within its bounds. Raise InputError if y is not finite.
        """
        if not bool(y.isfinite().all()):
            raise InputError(f"measured positions must be finite, got {y.tolist()}; leave that sample out")
        P, surprise = belief.covariance, 0.0
        x = torch.cat([self._row(belief), *(() if belief.earlier is None else belief.earlier)])
        for i in range(self.n):
            own = self.noise.position[i] ** 2
            miss, variance = float(y[i] - x[i]), float(P[i, i]) + own
            if self.model.config.angles[i]:
                miss -= 2 * math.pi * math.floor(miss / (2 * math.pi) + 0.5)
            surprise += miss * miss / variance
            gain = P[:, i] / variance
            x, P = x + gain * miss, P - torch.outer(gain, gain) * variance
            # P_i − gain P_ii = gain σ², without cancellation.
            P[i] = P[:, i] = gain * own
        rows = x.reshape(-1, self.size)
        rows[:, self.kept :] = torch.minimum(torch.maximum(rows[:, self.kept :], self.low), self.high)
        earlier, scale, weight = None if belief.earlier is None else rows[1:], float(belief.scale), belief.weight
        surprise /= scale
        if self.noise.adaptation > 0:
            weight = (1 - self.noise.adaptation) * weight + 1
            scale += (surprise / self.n - 1) / weight * scale
        return Belief(*self._parts(rows[0], belief.state.s), P, earlier, scale, weight), surprise

    def _row(self, belief: Belief) -> Tensor:
        """The numbers (F,) of the filter's state."""
        q, p, s = belief.state
        return torch.cat([torch.cat([q, p, s[None]])[: self.kept], belief.theta])

    def _parts(self, x: Tensor, s: Tensor) -> tuple[State, Tensor]:
        """State and θ of the numbers x (F,); `s` is used if the motion does not depend on s."""
        n, kept = self.n, self.kept
        return State(x[:n], x[n : 2 * n], x[2 * n] if kept > 2 * n else s), x[kept:]

    def velocity(self, belief: Belief, h: Tensor | float, u: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The velocity (n,) and its covariance (n, n); of a batch of beliefs if no θ is estimated.

        v = 4 d(h/2)/h − d(h)/h from the moves d of steps of h and h/2, exact to order 2 in h. Raise InputError if the
        model has no step there.
        """
        n, kept, P = self.n, self.kept, belief.covariance
        v, G = torch.zeros_like(belief.state.q), P.new_zeros(*P.shape[:-2], n, P.shape[-1])
        h = torch.as_tensor(h, dtype=P.dtype)
        for size, by in ((h, -1 / h), (h / 2, 4 / h)):
            found = self._stepped(belief, size, u)
            v = v + by[..., None] * (found.step.state.q - belief.state.q)
            own = found.by_state[..., :n, :kept] - torch.eye(n, kept, dtype=P.dtype)
            G[..., :kept] += by[..., None, None] * own
            if found.by_parameters is not None:
                G[..., kept:] += by[..., None, None] * found.by_parameters[..., :n, :]
        return v, torch.as_tensor(belief.scale, dtype=P.dtype)[..., None, None] * (G @ P @ G.mT)

    def _stepped(self, belief: Belief, h: Tensor | float, u: Tensor | None) -> Linearised:
        values = dict(zip(self.names, belief.theta.tolist(), strict=True)) if self.names else {}
        if self.stepper is not None:
            found = (self.stepper.with_parameters(values) if values else self.stepper).linearise(belief.state, h, u)
        else:
            model = with_values(self.model, values) if values else self.model
            found = Stepper(model).linearise(belief.state, h, u, self.names)
        failed = found.step.status != Status.CONVERGED
        if bool(failed.any()):
            at, size = belief.state.q[failed].reshape(-1, self.n)[0], float(torch.as_tensor(h).max())
            reason = Status(int(found.step.status[failed][0])).name
            raise InputError(f"the model has no step of {size:g} from q = {at.tolist()} ({reason}); start nearer to it")
        return found
