"""Re-train a model's correction for a larger step, on motions of the accurate model.

A motion known at every small step gives an exact flow map at every multiple H of that step. One discrete Lagrangian
generates the map in the same coordinates (q, p, s), so each pair of states (q0, p0, s0) → (q1, p1, s1) gives three
residuals,

    J⁻¹(D1 L_d + c p0),    J⁻¹(D2 L_d − p1),    (s0 + L_d − s1)/P,

all in units of q, with J = ∂(D1 L_d + c p0)/∂q1 and P a typical momentum. No state is latent or noisy, so
Levenberg–Marquardt converges. States of the run are states of the distilled model too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.mechanics import momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, solve
from herglotz.training import Prior, levenberg_marquardt
from herglotz.training.parameter_vector import ParameterVector

# Number of pairs whose Jacobians are in memory at the same time.
CHUNK = 1024
# σ of the residuals over the size of the motion. The pairs have no noise, so σ only keeps the prior weak.
RELATIVE_SIGMA = 1e-8

# (θ, before, after) → residuals (..., m) of pairs of states
Residual = Callable[[Tensor, State, State], Tensor]


class FlowProblem:
    """½ Σ |r/σ|² + prior for the residuals r of T pairs of states, with σ () or (m,), a value for each residual."""

    def __init__(self, residual: Residual, before: State, after: State, sigma: Tensor, prior: Prior | None = None):
        self.residual, self.before, self.after = residual, before, after
        self.sigma, self.prior = sigma, prior

    def residuals(self, theta: Tensor) -> Tensor:
        """Return the residuals, (T, m)."""
        with torch.no_grad():
            return self.residual(theta, self.before, self.after)

    def cost(self, x: Tensor) -> Tensor:
        """Return ½ Σ |r/σ|² + prior."""
        cost = (self.residuals(x) / self.sigma).square().sum() / 2
        return cost if self.prior is None else cost + self.prior.cost(x)

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (cost, JᵀJ, Jᵀr), accumulated over chunks of pairs."""
        cost, A, b = (x.new_zeros(()),) * 3 if self.prior is None else self.prior.normal_equations(x)
        slopes = vmap(jacrev(lambda *x: (r := self.residual(*x), r), has_aux=True), (None, 0, 0))
        for part in torch.arange(len(self.before.s)).split(CHUNK):
            J, r = slopes(x, *(State(*(y[part] for y in states)) for states in (self.before, self.after)))
            J, r = (J / self.sigma[..., None]).reshape(-1, len(x)), (r / self.sigma).reshape(-1)
            cost, A, b = cost + r.square().sum() / 2, A + J.T @ J, b + J.T @ r
        return cost, A, b


def distillation(model: ContactLagrangian, before: State, after: State, h: float) -> FlowProblem:
    """Return the problem over all parameters of a model, for pairs of states a time h apart; residuals (T, 2n + 1)."""
    parameters, h_ = ParameterVector(model), before.s.new_tensor(h)
    typical_momentum = float(before.p.square().mean().sqrt().clamp(min=1e-12))

    def residual(theta: Tensor, before: State, after: State) -> Tensor:
        (q0, p0, s0), (q1, p1, s1) = before, after
        P = parameters.partials(theta, q0, q1, s0, h_, 2)
        J = momentum_jacobian(P, p0)
        action = (s0 + P.L - s1) / typical_momentum
        position, momentum = solve(J, momentum_residual(P, p0)), solve(J, momentum_plus(P) - p1)
        return torch.cat([position, momentum, action[..., None]], -1)

    sigma = before.s.new_tensor(RELATIVE_SIGMA * float(max(model.config.scale)))
    prior = Prior(model, before.q.amin(0), before.q.amax(0), departure=None)
    return FlowProblem(residual, before, after, sigma, prior)


def widened(model: ContactLagrangian, width: int, depth: int = 2) -> ContactLagrangian:
    """Return the model with a correction of this size: the model's if the size is the same, else a correction of 0."""
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
    """Fit a copy of the model to a flow map over h; return the copy and the RMS of its residuals, in units of q."""
    problem, first = distillation(model, before, after, h), ParameterVector(model).get()
    result = levenberg_marquardt(problem, first, max_iterations=iterations, rtol=1e-3)
    new = ContactLagrangian(model.config).to(next(model.parameters()).dtype)
    ParameterVector(new).set(result.x)
    return new, float(problem.residuals(result.x).square().mean().sqrt())
