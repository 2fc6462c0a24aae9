"""Every new level of the ladder, fitted to a scene that needs it from exact positions alone."""

from dataclasses import fields, replace
from typing import Any

import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import reference_solve, scene
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, ResidualProblem, fit, levenberg_marquardt
from herglotz.training.baseline import estimate_baseline
from herglotz.training.problems.prior import prior_of


def build(config) -> Any:
    """The model; which of its terms are there is what the tests know and types do not."""
    return ContactLagrangian(config)


def one_step_fit(data, iterations=40, s0=None, **settings) -> tuple[Any, torch.Tensor]:
    """(model, residuals of the triples that were held out): a fit to two triples of three; s0 starts the latents."""
    base = estimate_baseline(data)
    sizes = {k: getattr(base, k) for k in ("angles", "scale", "speed", "stiffness", "tilt", "rate")}
    model = build(replace(ModelConfig(**sizes, damping_width=6), **settings))
    problem = ResidualProblem(model, data, sigma=1e-8, prior=prior_of(model, base, 6e-3))
    t = problem.triples
    held = torch.arange(len(t)) % 3 == 2
    problem.triples, problem.deviation = pick(t, ~held), problem.deviation[~held]
    x = problem.start()
    if s0 is not None and problem.latents:
        x[-problem.latents :] = s0
    x = levenberg_marquardt(problem, x, max_iterations=iterations).x
    problem.parameters.set(x[: len(problem.parameters.get())])
    problem.triples = pick(t, held)
    return model, problem.residuals(x)


def pick(triples, mask):
    return type(triples)(**{f.name: getattr(triples, f.name)[mask] for f in fields(triples)})


def rms(x):
    return float(x.square().mean().sqrt())


def recorded(vector_field, q, p, s, h, steps):
    """A set of trajectories (K+1 samples each) of a vector field on (q, p, s), by the reference integrator."""
    rows = [q]
    for _ in range(steps):
        x = reference_solve(vector_field, q, p, s, h)
        q, p, s = x.q1, x.p1, x.s1
        rows.append(q)
    q = torch.stack(rows, 1)  # (B, K+1, n)
    t = (torch.arange(steps + 1, dtype=torch.float64) * h).repeat(len(q))
    angles = (True,) * q.shape[-1]
    return Trajectories.of(t, q.flatten(0, 1), (steps + 1,) * len(q), angles=angles)


def starts(count, n, seed=0):
    make = torch.Generator().manual_seed(seed)
    draw = lambda *shape: 2 * torch.rand(*shape, generator=make, dtype=torch.float64) - 1  # noqa: E731
    return 1.2 * draw(count, n), draw(count, n), draw(count)


def test_conservative_level_fits_an_undamped_pendulum():
    # fails if the level cannot be trained by `fit`: no rate, no s, no prior on either
    data = simulate(scene("damped_pendulum", gamma=1e-300), trajectories=5, steps=30, h=0.3, seed=0)
    run = fit(data, FitConfig(level="conservative", objective="residual", iterations=40, correction_width=8))
    assert run.metrics["rate"] is None
    assert run.metrics["one_step_rms"] < 1e-3 * run.metrics["one_step_rms_constant_velocity"]
    assert run.metrics["extrapolation_rms"] < 1e-3


def test_forced_level_recovers_the_friction_of_each_joint():
    # fails if forces do not reach J, R or their derivatives: one rate cannot tell the joints apart
    sizes = {"angles": (True, True), "scale": (1.2, 1.2), "speed": (1.5, 1.5), "tilt": (0.0, 0.0)}
    truth = build(ModelConfig(**sizes, level="forced", stiffness=(1.0, 1.6), rate=0.05, potential_width=0))
    b = torch.tensor([0.3, 0.05], dtype=torch.float64)
    with torch.no_grad():
        truth.friction.viscous.copy_(b)
        truth.kinetic.off_diagonal.fill_(0.4)
        truth.kinetic.log_diagonal.fill_(-0.1)
        out = Stepper(truth).rollout(*starts(6, 2), h=0.15, steps=40)
    t = (torch.arange(41, dtype=torch.float64) * 0.15).repeat(6)
    data = Trajectories.of(t, out.q.flatten(0, 1), (41,) * 6, angles=(True, True))
    model, error = one_step_fit(data, level="forced", potential_width=0)
    found = model.friction.viscous.detach()
    _, linear = one_step_fit(data, level="linear", potential_width=0)
    assert float((found - b).abs().max()) < 1e-3
    assert rms(error) < 1e-3 * rms(linear)


def test_a_mass_that_depends_on_position_is_found():
    # fails if m(q̄) is not differentiated, or cannot leave the constant: a bead on a wire, m = 1 + sin²q / 2
    def field(q, p, s):
        m, slope = 1 + 0.5 * torch.sin(q) ** 2, 0.5 * torch.sin(2 * q)
        v = p / m
        return v, -torch.sin(q) + v * v * slope / 2 - 0.1 * p, (p * v / 2 + torch.cos(q) - 1)[..., 0] - 0.1 * s

    data = recorded(field, *starts(6, 1), 0.05, 60)
    errors = {}
    for width in (0, 6):
        model, error = one_step_fit(data, mass_width=width, potential_width=6)
        errors[width] = rms(error)
    q = torch.linspace(-1, 1, 9, dtype=torch.float64)[:, None]
    m = model.kinetic.mass(q).detach()[:, 0, 0]
    assert errors[6] < 0.1 * errors[0]
    torch.testing.assert_close(m, 1 + 0.5 * torch.sin(q[:, 0]) ** 2, rtol=0, atol=0.02)
