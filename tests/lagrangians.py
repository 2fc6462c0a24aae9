"""Discrete Lagrangians, models and states that several rooms are tested with."""

from typing import Any

import torch

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes.scene import Scene
from herglotz.stepping import State


def states(n: int = 1, count: int = 16, seed: int = 0, dtype: torch.dtype = torch.float64) -> State:
    """Normal positions (count, n), momenta (count, n) and actions (count,)."""
    x = torch.randn(count, 2 * n + 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)
    return State(x[:, :n], x[:, n : 2 * n], x[:, -1])


def states_in_turn(n: int = 1, count: int = 9, seed: int = 0, dtype: torch.dtype = torch.float64) -> State:
    """The same kind of states; all positions are drawn before the momenta, and these before the actions."""
    make = torch.Generator().manual_seed(seed)
    q, p = (torch.randn(count, n, generator=make, dtype=torch.float64).to(dtype) for _ in range(2))
    return State(q, p, torch.randn(count, generator=make, dtype=torch.float64).to(dtype))


def scene_states(system: Scene, count: int = 3, seed: int = 0, dtype: torch.dtype = torch.float64) -> State:
    """Uniform positions and velocities in the scene's ranges, and actions in −1 … 1."""
    make = torch.Generator().manual_seed(seed)
    draws = []
    for limits in (system.q_range, system.v_range):
        low, high = (torch.as_tensor(x, dtype=torch.float64) for x in limits)
        draws.append(low + (high - low) * torch.rand(count, system.dof, generator=make, dtype=torch.float64))
    (q, v), s = draws, 2 * torch.rand(count, generator=make, dtype=torch.float64) - 1
    return State(*(x.to(dtype) for x in (q, system.momentum(q, v, s), s)))


def nonlinear(q0, q1, s0, h):
    """Golden 2-dof system of section 4 of `docs/mathematics.md`: nonlinear in s, not symmetric in the coordinates."""
    d, m = (q1 - q0) / h[..., None], 0.5 * (q0 + q1)
    kinetic = 0.5 * (1 + 0.3 * torch.sin(m[..., 0])) * d[..., 0] ** 2 + 0.6 * d[..., 1] ** 2 + 0.2 * d.prod(-1)
    friction = 0.3 * s0 + 0.1 * torch.sin(s0) * (1 + 0.2 * m[..., 1]) + 0.05 * s0 * d[..., 0]
    return h * (kinetic - torch.cos(m.prod(-1)) - 0.25 * (m * m).sum(-1) - friction)


def verlet_pendulum(q0, q1, s0, h):
    """A damped pendulum by a rule of order 1, any number of coordinates."""
    v = (q1 - q0) / h[..., None]
    return h * ((v * v / 2 + torch.cos(q0)).sum(-1) - 0.2 * s0)


def pendulum_of_time(q0, q1, s0, t0, h):
    """Midpoint rule for a pendulum whose pivot and damping change with time."""
    v, q, t = (q1 - q0) / h[..., None], 0.5 * (q0 + q1), t0 + 0.5 * h
    L = (0.5 * v * v * (1 + 0.3 * torch.sin(q)) + torch.cos(q) * (1 + 0.5 * torch.cos(2 * t)[..., None])).sum(-1)
    return h * (L - 0.2 * s0 - 0.1 * torch.sin(s0) * torch.sin(t))


def cubic(q0, q1, s0, h):
    """No step exists for a large positive momentum at q0 = 0: F = −q1 + q1³/3·… has a turning point (det M = 0)."""
    return (-q0 * (q1 - q1**3 / 3)).sum(-1) + 0 * s0 * h


def bowl(q):
    """A convex function of position that is not quadratic."""
    return 0.6 * (q * q).sum(-1) + 0.1 * torch.cos(q.sum(-1)) + 0.2 * q[..., 0]


def wavy(q):
    """A function of two coordinates without symmetry."""
    return torch.sin(q[..., 0]) + 0.4 * q[..., 1] ** 3 + q[..., 0] * q[..., 1]


@torch.no_grad()
def randomise(model: torch.nn.Module, spread: float, seed: int) -> torch.Generator:
    """Move every parameter by normal numbers times `spread`; the generator, for what is drawn after them."""
    make = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter += spread * torch.randn(parameter.shape, generator=make, dtype=parameter.dtype)
    return make


def random_model(
    config: ModelConfig, dtype: torch.dtype = torch.float64, spread: float = 0.3, seed: int = 3
) -> ContactLagrangian:
    """A model whose parameters are all off their defaults."""
    model = ContactLagrangian(config)
    randomise(model, spread, seed)
    return model.to(dtype)


def even_model() -> ContactLagrangian:
    """A learned model that rests at q = 0: units come in pairs, (q̄, v) → −(q̄, v), whose forces cancel to rounding."""
    model: Any = ContactLagrangian(ModelConfig(rate=0.5, correction_width=16, correction_depth=1, seed=1))
    (weight, last), (bias,) = model.correction.network.weights, model.correction.network.biases
    with torch.no_grad():
        weight[8:] = weight[:8] * torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)
        bias[8:] = bias[:8]
        last[:] = 0.1
    return model
