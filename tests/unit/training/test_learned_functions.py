"""What a run has learned as functions: their gauge, and bands that hold a truth that no term of the model says."""

import math
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import function_bands
from benchmarks.function_bands import truth
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.plots import plot_learned
from herglotz.training import Plan, ShootingProblem, fit, laplace, learned_functions
from herglotz.training.cross_validation import FOLDS, data_rows, foretold_errors, held_out_errors
from herglotz.training.learned_functions import FunctionPosterior, _Linear, _Lines, function_posterior, mass_at
from herglotz.training.parameter_vector import ParameterVector
from tests.compared import dense

INF = float("inf")
PLAN = Plan(
    "linear", "trajectory", "none", 2, ("q1^2", "q1^4", "q1^6"), "", 0.0, 0.0, (), 2, {"alike": True},
    {"stiffness": (0.0,), "tilt": (0.0,), "rate": (0.1,), "potential.features.sum.coefficient": (1.5, -1.0, 0.3)},
    False, False, 0.002, True, 1, (2e-3,),
)  # fmt: skip


@pytest.fixture(scope="module")
def fitted():
    """A law, and a fit of four numbers to it: a log-cosh well, whose force is no polynomial, and viscous friction."""
    rng = np.random.default_rng(5)
    law = function_bands.law("saturating", rng)
    law = replace(law, friction=lambda q, v: 0.1 * v)  # noqa: ARG005
    steep: Any = lambda q: 1.5 * np.tanh(2.0 * q)  # noqa: E731
    slope: Any = lambda q, v, w, u: (-steep(q) - 0.1 * v, w)  # noqa: ARG005, E731
    law = replace(law, slope=steep, mechanism=replace(law.mechanism, slope=slope))
    data = function_bands.recorded(law, rng)
    return law, laplace(fit(data, plan=PLAN, progress=False))


def by_kind(functions):
    return {f.kind: f for f in functions}


def test_a_band_holds_a_function_that_no_term_of_the_model_says(fitted):
    # fails if the posterior is that of the model's own numbers or if the band is about the model's curve
    law, posterior = fitted
    found = by_kind(learned_functions(posterior))
    for kind, least in (("potential", 0.75), ("force", 0.75), ("friction", 0.0)):
        f = found[kind]
        true, (low, high) = truth(law, posterior.run, f), f.interval(0.9)
        inside = (low.numpy() <= true) & (true <= high.numpy())
        assert inside.mean() >= least, kind
        low, high = f.interval(0.9999)
        assert ((low.numpy() <= true) & (true <= high.numpy())).mean() > 0.95, kind
        assert f.std is not None
        assert float(f.std.square().mean().sqrt()) < 0.03 * np.abs(true).max(), kind


def test_the_numbers_of_a_model_alone_say_too_little_of_its_functions(fitted):
    # fails if the fit above could do without the waves: what is measured here is why bands have them
    law, posterior = fitted
    run, P = posterior.run, len(posterior.theta)
    lines = _Lines(run, 101, 0.0)
    J = torch.cat(list(lines.by_numbers(run.model, posterior.theta)))
    std = ((J @ posterior.covariance[:P, :P]) * J).sum(1).sqrt()[101:202].numpy()
    force = by_kind(learned_functions(run))["force"]
    missed = np.abs(truth(law, run, force) - force.value.numpy())
    assert np.mean(missed < 1.645 * std) < 0.1


def test_what_blocks_are_missed_by_is_over_what_the_fit_foretells(fitted):
    # fails if a fit of many numbers, which knows little of a block that is left out, is called worse than its noise
    posterior = fitted[1]
    of, theta, path, A = posterior.problem, posterior.theta, posterior.path, posterior.matrix
    r, own = data_rows(of, path, theta)
    r, P, segment = r[:, 0], of.P, of.grid.segment
    J = own.new_zeros(len(r), P + len(of.data) * of.d)
    J[:, :P] = own[:, 0, :P]
    for i in range(of.d):
        J[torch.arange(len(r)), P + segment * of.d + i] = own[:, 0, P + i]
    H, each = J @ torch.linalg.inv(dense(A)) @ J.T, []
    fold = torch.cat([torch.arange(k) * FOLDS // k for k in of.data.lengths])
    for k in range(FOLDS):
        rows = fold == k
        left = torch.linalg.solve(torch.eye(int(rows.sum())) - H[rows][:, rows], r[rows])
        each.append(float((r[rows] @ left / rows.sum()).sqrt()))
    found = foretold_errors(of, path, theta, A)
    torch.testing.assert_close(found, torch.tensor(each).double(), rtol=1e-5, atol=0)
    assert bool((found < held_out_errors(of, path, theta, A) / of.sigma).all())


def test_bands_are_computed_by_the_kernel(fitted, monkeypatch):
    # fails if torch steps through the recording with derivatives by all waves: the report on 250 000 samples took more
    # than 200 s and 2.8 GB, and takes 17 s and 0.8 GB
    monkeypatch.setattr(ShootingProblem, "sensitivities", lambda *_, **__: pytest.fail("stepped by torch"))
    assert learned_functions(fitted[1])[0].std is not None


def test_functions_stand_in_one_gauge(fitted):
    # fails if V has a constant, its slope is not the force, or a constant force of friction is counted as friction
    run = fitted[1].run
    found = by_kind(learned_functions(run, points=401))
    V, F = found["potential"], found["force"]
    assert abs(float(V.value.mean())) < 1e-12
    slope = torch.gradient(V.value, spacing=(V.x,))[0]
    torch.testing.assert_close(-slope[1:-1], F.value[1:-1], rtol=0, atol=1e-3)
    config = replace(run.model.config, level="forced", drag=("cos(2 v1)",))
    pushed = ContactLagrangian(config)
    pushed.load_state_dict(run.model.state_dict(), strict=False)
    assert pushed.drag is not None
    pushed.drag.coefficient.data.fill_(0.3)
    other = by_kind(learned_functions(replace(run, model=pushed), points=401))
    torch.testing.assert_close(other["force"].value, F.value - 0.3, rtol=0, atol=1e-9)
    more = -0.3 * ((2 * other["friction"].x).cos() - 1)
    torch.testing.assert_close(other["friction"].value - found["friction"].value, more, rtol=0, atol=1e-9)
    slope = torch.gradient(other["potential"].value, spacing=(V.x,))[0]
    torch.testing.assert_close(-slope[1:-1], other["force"].value[1:-1], rtol=0, atol=1e-3)


def test_a_mass_that_moves_has_one_in_the_mean(fitted):
    # fails if forces are those of another mass: positions leave the scale of M, V and friction free
    run = fitted[1].run
    wave = ContactLagrangian(replace(run.model.config, known=("0.2 q1^2 v1^2", "0.5 v1^2"), order=2))
    wave.load_state_dict(run.model.state_dict(), strict=False)
    found = by_kind(learned_functions(replace(run, model=wave)))
    lines = _Lines(run, 3, 0.0)
    unit = 2 + 0.4 * float(lines.some.square().mean())
    x = found["mass"].x
    torch.testing.assert_close(found["mass"].value, (2 + 0.4 * x * x) / unit, rtol=1e-9, atol=0)
    torch.testing.assert_close(
        found["force"].value, by_kind(learned_functions(run))["force"].value / unit, rtol=1e-9, atol=1e-12
    )


def test_derivatives_by_numbers_are_those_of_differences(fitted):
    # fails if a function does not see the numbers, or those of another order
    run = fitted[1].run
    numbers, lines = ParameterVector(run.model), _Lines(run, 5, 0.0)
    theta = numbers.get()
    J = torch.cat(list(lines.by_numbers(run.model, theta)))
    for i in range(len(theta)):
        ends = []
        for side in (1e-5, -1e-5):
            numbers.set(theta + side * torch.eye(len(theta), dtype=theta.dtype)[i])
            ends.append(lines.values(run.model).detach())
        numbers.set(theta)
        torch.testing.assert_close(J[:, i], (ends[0] - ends[1]) / 2e-5, rtol=1e-6, atol=1e-8)


def test_masses_and_derivatives_cost_no_more_than_they_need(fitted, monkeypatch):
    # fails if the potential is evaluated for a mass, which took minutes of the figures of a chain of 32 bodies, or if
    # the derivatives of one function are taken through all functions
    run = fitted[1].run
    lines, seen = _Lines(run, 5, 0.0), []
    monkeypatch.setattr(type(run.model.potential), "forward", lambda *_: pytest.fail("a potential for a mass"))
    assert mass_at(run.model, lines.some, run.h).shape == (1, 1, len(lines.some))
    monkeypatch.undo()
    monkeypatch.setattr(_Lines, "_value", lambda *parts: seen.append(parts[2]) or parts[4])
    assert len(list(lines.by_numbers(run.model, ParameterVector(run.model).get()))) == len(seen) == len(lines.parts)


def test_a_model_of_networks_has_the_posterior_of_its_numbers(fitted):
    # fails if waves are given to a model whose functions networks hold
    run = fitted[1].run
    posterior = laplace(replace(run, model=networked(run.model)))
    found = function_posterior(posterior)
    assert found.model is posterior.run.model
    own = posterior.covariance[: len(found.theta), : len(found.theta)]
    torch.testing.assert_close(found.covariance * found.factor**2, own)


def test_blocks_that_cannot_be_foretold_leave_no_band(fitted, monkeypatch):
    # fails if ∞ times a derivative of 0, of friction at rest, is no number, or a band is drawn beyond the data
    posterior = fitted[1]
    figure = plot_learned(posterior.run, posterior)
    for f, ax in zip(learned_functions(posterior.run), figure.axes, strict=True):
        (band,) = ax.collections
        x = np.asarray(band.get_paths()[0].vertices)[:, 0]
        assert f.low <= x.min() < x.max() <= f.high
    unknown = FunctionPosterior(posterior.run.model, posterior.theta, torch.eye(len(posterior.theta)).double(), INF)
    monkeypatch.setattr(sys.modules["herglotz.training.learned_functions"], "function_posterior", lambda _: unknown)
    assert all(bool((f.std == INF).all()) for f in learned_functions(posterior) if f.std is not None)
    assert not any(ax.collections for ax in plot_learned(posterior.run, posterior).axes)


def networked(model):
    """The same motion with a network in V that is 0."""
    made = ContactLagrangian(replace(model.config, potential_width=2))
    made.load_state_dict(model.state_dict(), strict=False)
    return made


def test_what_has_no_band_says_so(fitted):
    # fails if a run without a posterior has a band of width 0, or a wrong number of points an error of torch
    run = fitted[1].run
    force = by_kind(learned_functions(run))["force"]
    with pytest.raises(InputError, match=r"learned_functions\(laplace\(run\)\)"):
        force.interval()
    with pytest.raises(InputError, match="points must be 2 or more, got 1"):
        learned_functions(run, points=1)
    with pytest.raises(InputError, match="beyond must be >= 0, got -1"):
        learned_functions(run, beyond=-1.0)
    assert force.low < force.x[50] < force.high
    wide = by_kind(learned_functions(run, beyond=0.5))["force"]
    assert wide.std is None
    assert float(wide.x[-1] - wide.x[0]) == pytest.approx(2 * (force.high - force.low))


def test_a_number_without_effect_leaves_the_strengths_alone():
    # fails if a mass that the data took to 0, whose number moves nothing, ends the report on a spring pendulum in an
    # internal error ("eigh failed to converge")
    def strengths(A, of):
        n, A = len(A), torch.tensor(A).double()
        linear = _Linear(
            torch.diag(A), (A > 0).double(), 1e3, 500, torch.zeros(n).double(), False,
            torch.zeros(n).double(), torch.tensor([4.0 * (k == 0) for k in of]).double(), torch.tensor(of),
            torch.ones(n).double(), 1,
        )  # fmt: skip
        return linear.likeliest(0)

    likelihood, step, weight, variance = strengths([0.0, 1e6, 1e5], [1, 0, 0])
    _, own, _, its = strengths([1e6, 1e5], [0, 0])
    assert math.isfinite(likelihood)
    assert variance == pytest.approx(its, rel=0.01)  # it counts as a number
    torch.testing.assert_close(step[1:], own, rtol=0.01, atol=0)
    assert weight[0, 0] == 0
