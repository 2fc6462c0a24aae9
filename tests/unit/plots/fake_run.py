"""A run as the fit returns it, without a fit: a model near the truth, its free run, and an invented history."""

from functools import cache

import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.training import FitConfig, Plan, Run
from herglotz.training.recorded_range import box_of

simulated = cache(simulate)
TERMS = "cos(q1) explains the data to 0.01"
START = {"stiffness": (1.0,), "tilt": (0.0,), "rate": (0.2,)}
PLAN = Plan(
    "linear", "trajectory", "none", 2, ("cos(q1)",), "", 0.0, 0.0, (), 1, {"alike": True}, START, False, False, 0.01,
    True, 1, (2e-4, 6e-4, 2e-3, 6e-3),
    reasons={"level": TERMS, "objective": "the data are noisy", "features": TERMS, "outliers": ""},
)  # fmt: skip


def fake_run(
    trajectories: int = 1,
    steps: int = 60,
    level: str = "linear",
    dof: int = 1,
    fraction: float = 2 / 3,
    dtype: torch.dtype = torch.float64,
) -> Run:
    """Pendulum data, or an oscillator in the plane for two coordinates."""
    h = 0.2
    data = simulated("damped_pendulum", trajectories=trajectories, steps=steps, h=h, noise=0.01, gaps=0, seed=3)
    rate = 0.201
    config = ModelConfig(angles=(True,), level=level, rate=rate, potential_width=0)
    if dof == 2:
        config = ModelConfig(
            angles=(False,) * 2, level=level, scale=(1.0,) * 2, speed=(1.0,) * 2, stiffness=(1.0, 2.0),
            tilt=(0.0,) * 2, rate=rate, potential_width=0,
        )  # fmt: skip
    model = ContactLagrangian(config)
    parts = []
    for b in range(trajectories):
        q0 = data[b].q[0].expand(dof).clone()
        p0 = (data[b].q[1] - data[b].q[0]).expand(dof) / h
        with torch.no_grad():
            parts.append(Stepper(model).rollout(q0, p0, q0.new_zeros(()), h=h, steps=steps))
    states = State(torch.cat([x.q for x in parts]), torch.cat([x.p for x in parts]), torch.cat([x.s for x in parts]))
    if dof == 2:
        noise = 0.01 * torch.randn(states.q.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        data = Trajectories.of(data.t, states.q + noise, data.lengths, names=("x", "y"), units=("m", "m"))
    count = round(fraction * (steps + 1))
    history = [{"stage": "residual", "iteration": k, "cost": 30.0 * 0.5**k + 2} for k in range(12)]
    history += [{"stage": "horizon 30", "iteration": 12 + k, "cost": 90 * 0.6**k + 5} for k in range(10)]
    history += [{"stage": "whole trajectory", "iteration": 22 + k, "cost": 40 * 0.3**k + 4} for k in range(8)]
    model, data, states = model.to(dtype), data.to(dtype), State(*(x.to(dtype) for x in states))
    box = box_of(*(x.double() for x in states))
    sizes = ((2, 0.1, False), (3, 0.02, False), (3, 0.01, True), (5, 0.011, False))
    compared = [{"numbers": k, "held_out": error, "offers": [], "taken": taken} for k, error, taken in sizes]
    return Run(
        model,
        FitConfig(level=level),
        {"plan": PLAN.to_dict(), "compared": compared},
        data,
        (count,) * trajectories,
        states,
        h,
        box,
        history,
    )
