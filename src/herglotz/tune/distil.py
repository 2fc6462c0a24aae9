"""Re-train a model's big-step correction at another step, on motions of the accurate model.

A motion known at every small step gives an exact flow map at every multiple H of that step. One discrete Lagrangian
generates the map in the same coordinates (q, p, s), so each pair of states (q0, p0, s0) → (q1, p1, s1) gives three
residuals,

    J⁻¹(D1 L_d + c p0),    J⁻¹(D2 L_d − p1),    (s0 + L_d − s1)/P,

all in units of q, with J = ∂(D1 L_d + c p0)/∂q1 and P a typical momentum. No state is latent or noisy, so
Levenberg–Marquardt converges. States of the run are states of the distilled model too.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, solve
from herglotz.training import Prior, levenberg_marquardt
from herglotz.training.parameter_vector import ParameterVector

CHUNK = 1024  # pairs whose Jacobians are held at once
EXACT = 1e-8  # σ of the residuals relative to the motion's size


class FlowProblem:
    """½ Σ |r|²/σ² + prior over the parameters of a model, for T pairs of states a time H = h apart."""

    def __init__(self, model: ContactLagrangian, before: State, after: State, h: float):
        self.parameters, self.before, self.after = ParameterVector(model), before, after
        self.h = before.s.new_tensor(h)
        self.momentum = float(before.p.square().mean().sqrt().clamp(min=1e-12))
        self.sigma = EXACT * float(max(model.config.scale))
        low, high = before.q.amin(0), before.q.amax(0)
        self.prior = Prior(model, low, high, departure=None)

    def residuals(self, theta: Tensor) -> Tensor:
        """Return the residuals, (T, 2n + 1), in units of q."""
        with torch.no_grad():
            return self._local(theta, self.before, self.after)

    def cost(self, x: Tensor) -> Tensor:
        """Return ½ Σ |r|²/σ² + prior."""
        return self.residuals(x).square().sum() / (2 * self.sigma**2) + self.prior.cost(x)

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (cost, JᵀJ, Jᵀr), accumulated over chunks of pairs."""
        cost, A, b = self.prior.normal_equations(x)
        slopes = vmap(jacrev(lambda *x: (r := self._local(*x), r), has_aux=True), (None, 0, 0))
        for part in torch.arange(len(self.before.s)).split(CHUNK):
            pair = (State(*(y[part] for y in one)) for one in (self.before, self.after))
            J, r = slopes(x, *pair)
            J, r = J.reshape(-1, len(x)) / self.sigma, r.reshape(-1) / self.sigma
            cost, A, b = cost + r.square().sum() / 2, A + J.T @ J, b + J.T @ r
        return cost, A, b

    def _local(self, theta: Tensor, before: State, after: State) -> Tensor:
        (q0, p0, s0), (q1, p1, s1) = before, after
        P = self.parameters.partials(theta, q0, q1, s0, self.h, 2)
        J = momentum_jacobian(P, p0)
        action = (s0 + P.L - s1) / self.momentum
        position, momentum = solve(J, momentum_residual(P, p0)), solve(J, momentum_plus(P) - p1)
        return torch.cat([position, momentum, action[..., None]], -1)


def widened(model: ContactLagrangian, width: int, depth: int = 2) -> ContactLagrangian:
    """Return the model with a correction of this size: its own if the size is the same, else a new one that is zero."""
    config = replace(model.config, correction_width=width, correction_depth=depth)
    new = ContactLagrangian(config)
    same = config == model.config
    known = {k: v for k, v in model.state_dict().items() if same or not k.startswith("correction")}
    new.load_state_dict(known, strict=False)
    return new.to(next(model.parameters()).dtype)


def pairs_of(states: State, stride: int, count: int, seed: int) -> tuple[State, State]:
    """Return at most `count` random pairs (state, state `stride` later) of motions (B, K+1, …)."""
    size = states.s.shape[1] - stride
    flat = [(x[:, :size].flatten(0, 1), x[:, stride:].flatten(0, 1)) for x in states]
    rows = torch.randperm(len(flat[2][0]), generator=torch.Generator().manual_seed(seed))[:count]
    return State(*(a[rows] for a, _ in flat)), State(*(b[rows] for _, b in flat))


def distil(
    model: ContactLagrangian, before: State, after: State, h: float, *, iterations: int = 80
) -> tuple[ContactLagrangian, float]:
    """A model whose parameters are fitted, from those it has, to a flow map over h; and its one-step RMS, as q is."""
    problem = FlowProblem(model, before, after, h)
    result = levenberg_marquardt(problem, problem.parameters.get(), max_iterations=iterations, rtol=1e-3)
    new = ContactLagrangian(model.config).to(next(model.parameters()).dtype)
    ParameterVector(new).set(result.x)
    return new, float(problem.residuals(result.x).square().mean().sqrt())
