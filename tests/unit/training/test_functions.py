"""Functions that no named term says: sums of waves with a prior, found by the search, and the true law beside them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests import runge_kutta

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.models.drag import parse_drag
from herglotz.models.features import parse
from herglotz.training import FitConfig, fit
from herglotz.training.baseline import estimate_baseline
from herglotz.training.functions import REACH, bands
from herglotz.training.moves import Moves
from herglotz.training.problems.prior import Gaussian, prior_of
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.search import Search
from herglotz.training.task import build_model
from herglotz.training.trials import Variant

H, NOISE = 0.05, 0.002


def recorded(acceleration, starts, *, angle, steps=160, parts=8):
    """Positions from starts (B, 2) under an acceleration of q and v, by Runge and Kutta, with noise."""
    x, out = np.array(starts, dtype=float).T, []
    rate = lambda x: np.stack([x[1], acceleration(*x)])  # noqa: E731
    for _ in range(steps + 1):
        out.append(x[0].copy())
        for _ in range(parts):
            x = runge_kutta.step(rate, x, H / parts)
    q = torch.tensor(np.array(out).T.reshape(-1, 1))
    q = q + NOISE * torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    t = (H * torch.arange(steps + 1, dtype=torch.float64)).repeat(len(starts))
    return Trajectories.of(t, q, (steps + 1,) * len(starts), angles=(angle,))


def well(q):
    """V′ of a log-cosh well with a bump."""
    return 2 * np.tanh(3 * q) - 6 * (q - 0.3) * np.exp(-(((q - 0.3) / 0.2) ** 2) / 2)


def ended(search):
    """The model that a search ends in."""
    named = search.run()
    assert named is not None
    return search.with_functions(named)


STARTS = [(0.9, 0.0), (-0.7, 0.6), (0.5, -0.9), (-0.4, 0.2)]


@pytest.fixture(scope="module")
def searched():
    """A search over motion in the well, which is damped by position, and the model that it ends in."""
    data = recorded(lambda q, v: -well(q) - (0.05 + 0.3 * np.exp(-4 * q * q)) * v, STARTS, angle=False)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    return search, ended(search)


def test_a_well_that_no_dictionary_holds_is_learned_as_a_function(searched):
    # fails if functions are not offered, their prior is that of another size, or a band is missing: the force is then
    # off by a tenth and more
    search, found = searched
    assert found.at_the_noise
    assert min(variant.substeps for variant in search.fitters if variant.functions) == 1  # not those of named terms
    assert any(name.startswith("V(q1)") for name in found.taken)
    assert any(name.startswith("damping(q1)") for name in found.taken)
    assert not any(name.startswith("mass(q1)") for name in found.taken)
    q = found.problem.data.q
    x = torch.linspace(float(q.quantile(0.02)), float(q.quantile(0.98)), 101, dtype=q.dtype)[:, None]
    with torch.no_grad():
        found.problem.parameters.set(found.theta)
        learned = found.fitter.model.potential(x, 1).gradient.flatten().numpy()
    true = well(x[:, 0].numpy())
    assert np.sqrt(np.mean((learned - true) ** 2)) < 0.05 * np.sqrt(np.mean(true**2))


def test_what_a_function_costs_is_what_the_data_tell_of_it(searched):
    # fails if each wave counts as a number whatever its prior says, or none does
    _, found = searched
    every = {wave for own in found.fitter.functions.values() for wave in own}
    waves = len(every & set(found.problem.parameters.numbers))
    told = found.score.numbers - (found.problem.P - waves)
    assert 4 < told < waves
    assert all(size > 0 for size in found.sizes.values())


def test_the_fit_to_a_part_and_the_linear_motion_have_the_priors_of_the_fit(searched, monkeypatch):
    # fails if a free run over held-out time, or what is said of offers, is of functions of another size
    _, found = searched
    assert found.scales
    asked, of = [], ShootingProblem.of

    def watched(*given):
        problem = of(*given)
        assert isinstance(problem.prior, Gaussian)
        asked.append(dict(zip(problem.parameters.numbers, problem.prior.weight.tolist(), strict=True)))
        return problem

    monkeypatch.setattr(ShootingProblem, "of", watched)
    found.fitter.foretold(found)
    Moves(found).scores([found.taken])
    at = {name: i for i, name in enumerate(found.problem.parameters.numbers)}
    assert len(asked) == 2
    for waves in found.fitter.functions.values():
        for wave in (wave for wave in waves if wave in at):
            assert {own[wave] for own in asked} == {float(found.prior.weight[at[wave]])}


def test_waves_of_a_part_are_those_of_all(monkeypatch):
    # fails if the waves that a search finds in a part of a long recording have another interval in the whole of it
    asked = []
    monkeypatch.setattr("herglotz.training.search.bands", lambda data: asked.append(data) or bands(data))
    monkeypatch.setattr("herglotz.training.search.PART", 170)
    data = recorded(lambda q, v: -well(q) - 0.1 * v, STARTS, angle=False)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    named = search.part.run()
    assert named is not None
    monkeypatch.setattr("herglotz.training.trials.Trial.at_the_noise", False)
    search.part.with_functions(named)
    search.part.of(search.part.data).with_functions(named)
    assert all(over is data for over in asked)
    of = next(variant for variant in search.part.fitters if variant.functions)
    assert {variant.functions for variant in search.part.fitters} == {(), of.functions}
    assert of.functions == tuple(bands(data))
    fitter = search.part.fitter(of)
    found = fitter.fit({*fitter.simple, "V(q1), waves 1-8"}, {}, fitter.lengths[0], None)
    assert found is not None
    whole = search.again(found)
    assert whole is not None
    assert whole.fitter.variant.functions == of.functions
    assert whole.fitter.data.samples > found.fitter.data.samples


@pytest.mark.parametrize("spread", [0.0, -1.0, math.nan, math.inf])
def test_a_prior_deviation_that_is_none_is_refused(spread):
    # fails if a plan of a file divides by it
    data = recorded(lambda q, v: -q - 0.1 * v, STARTS[:1], angle=False)
    base = replace(estimate_baseline(data), spreads={"q1^2": spread})
    with pytest.raises(InputError, match=r"'q1\^2' is .*, and has to be a number above 0"):
        prior_of(build_model(base, FitConfig(level="linear").resolved(data), "none"), base, None)


def test_waves_vanish_beyond_what_was_recorded():
    # fails if the interval or the phases of waves are those of other data
    q = torch.tensor([[5.0], [5.4], [5.1], [5.3]], dtype=torch.float64).repeat(10, 1)
    data = Trajectories.of(0.1 * torch.arange(40, dtype=torch.float64), q)
    found = [(band, text) for band in bands(data) if band.function == "V(q1)" for text in band.texts]
    half = REACH * 0.2
    for k, (_, text) in enumerate(found, 1):
        (product,) = parse(text, (False,))
        assert product.form[0] == pytest.approx(math.pi * k / (2 * half), rel=1e-6)
        for end in (5.2 - half, 5.2 + half):
            assert abs(math.sin(product.form[0] * end + product.phase)) < 1e-4
        assert product.function == "sin"


def test_waves_of_angles_are_periodic():
    # fails if a wave of an angle is not a whole one: after a turn it would be another force
    q = torch.linspace(0, 9, 60, dtype=torch.float64)[:, None]
    every = bands(Trajectories.of(0.1 * torch.arange(60, dtype=torch.float64), q, angles=(True,)))
    assert {band.function for band in every} == {"V(q1)", "damping(q1)", "mass(q1)"}
    for band in every:
        for text in band.texts:
            if band.function == "damping(q1)":
                assert parse_drag(text, (True,)).rate % 1 == 0
            else:
                assert all(product.form[0] % 1 == 0 for product in parse(text, (True,)))


def test_a_mass_that_turns_is_learned():
    # fails if only potentials are functions: M(q) q̈ = −½ M′(q) q̇² − 1.2 sin q − 0.1 q̇ with M = 1 + 0.4 cos q. The
    # first harmonics say it exactly
    def acceleration(q, v):
        return (0.2 * np.sin(q) * v * v - 1.2 * np.sin(q) - 0.1 * v) / (1 + 0.4 * np.cos(q))

    data = recorded(acceleration, [(2.5, 0.0), (-1.5, 1.0), (0.3, 2.2), (0.8, -1.8)], angle=True)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    found = ended(search)
    assert found.at_the_noise
    assert any(name.startswith("mass(q1)") for name in found.taken)


def test_no_functions_where_named_terms_are_at_the_noise():
    # fails if functions are tried for every recording: they would take the place of the law
    data = recorded(lambda q, v: -np.sin(q) - 0.1 * v, [(2.0, 0.0), (0.5, 1.0)], angle=True)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    found = search.run()
    assert found is not None
    assert found.taken == {"cos(q1)"}
    assert search.with_functions(found) is found
    assert not any(variant.functions for variant in search.fitters)
    assert search.fitter(Variant(2)).functions == {}


def test_joints_whose_masses_have_second_waves_have_these_offers():
    # fails if the mass of a rotating pendulum, sin² of its angle, is no offer
    q = torch.rand(60, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    every = bands(Trajectories.of(0.1 * torch.arange(60, dtype=torch.float64), q, angles=(True, True)))
    found = {text for band in every for text in band.texts}
    assert {"cos(2q2) v1 v1", "sin(2q1) v1 v2", "cos(2q1) v2 v2"} <= found


def test_a_run_steps_prints_and_keeps_its_functions(tmp_path):
    # fails if a plan forgets the priors of waves: a fit that follows it would be another one
    data = recorded(lambda q, v: -well(q) - 0.1 * v, STARTS, angle=False)
    run = fit(data, out=tmp_path, train_fraction=1.0)
    plan = run.metrics["plan"]
    assert plan["spreads"]
    assert set(plan["spreads"]) <= {*plan["features"], *plan["drag"]}
    text = str(run.equation())
    assert "f1(q) = " in text
    assert "fits to the noise" in run.metrics["verdict"]
