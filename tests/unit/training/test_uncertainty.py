"""The posterior of a fit: bands that cover."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.training import FitConfig, ShootingProblem, ensemble_bands, fit, laplace, uncertainty
from herglotz.training.uncertainty import schur
from tests.compared import dense

NOISE, INF = 0.01, float("inf")
SETTINGS = FitConfig(departures=(2e-3,), objective="trajectory")  # with networks, not with named terms


@pytest.fixture(scope="module")
def posteriors():
    """Fits of three noisy data sets, with what the noise hides."""
    found = []
    for seed in range(3):
        data = simulate(scene("damped_pendulum"), trajectories=3, steps=90, h=0.2, noise=NOISE, seed=seed)
        clean = simulate(scene("damped_pendulum"), trajectories=3, steps=90, h=0.2, seed=seed)
        run = fit(data, SETTINGS, progress=False)
        found.append((run, laplace(run), clean.q))
    return found


def held_out(run):
    rows = [
        torch.arange(first + trained, first + length)
        for first, length, trained in zip(run.data.offsets, run.data.lengths, run.train_lengths, strict=True)
    ]
    return torch.cat(rows)


def test_ninety_per_cent_bands_cover_held_out_samples(posteriors):
    # fails if sensitivities, the noise or the inflation are wrong: a band half or twice as wide is outside the range
    inside = [p.bands().inside(run.data.q)[held_out(run)].double().mean() for run, p, _ in posteriors]
    assert 0.80 <= float(torch.stack(inside).mean()) <= 0.97


def test_bands_cover_the_true_position_too(posteriors):
    # fails if the model's own uncertainty is left out or carries the measurement's noise
    shares = []
    for run, posterior, clean in posteriors:
        low, high = posterior.bands().interval(0.9, measured=False)
        rows = held_out(run)
        assert float((high - low)[rows].max()) < 4 * NOISE
        shares.append(((clean >= low) & (clean <= high))[rows].double().mean())
    assert 0.6 <= float(torch.stack(shares).mean()) <= 1.0


def test_the_band_of_the_start_is_what_sensitivities_say(posteriors):
    # fails if the covariance's blocks and the columns of the sensitivities are matched wrongly
    run, posterior, _ = posteriors[0]
    bands, P = posterior.bands(), len(posterior.theta)
    for first, joint in zip(run.data.offsets, posterior.joint(posterior.starts), strict=True):
        torch.testing.assert_close(bands.std[first, 0], joint[P, P].sqrt(), rtol=1e-8, atol=0)


def test_the_posterior_in_blocks_is_the_inverse_of_the_whole_matrix(posteriors):
    # fails if the starts are eliminated wrongly, which a set of thousands of recordings needs
    _, posterior, _ = posteriors[0]
    P, A, d = len(posterior.theta), dense(posterior.matrix).double(), posterior.problem.d
    whole = torch.linalg.inv(A) * posterior.inflation**2
    for b, joint in enumerate(posterior.joint(posterior.starts)):
        own = torch.cat([torch.arange(P), P + d * b + torch.arange(d)])
        torch.testing.assert_close(joint, whole[own[:, None], own], rtol=1e-6, atol=1e-9 * float(joint.abs().max()))
    torch.testing.assert_close(posterior.information, schur(A.flip(0, 1), P).flip(0, 1), rtol=1e-6, atol=0)


def test_derivatives_that_overflow_leave_no_posterior(posteriors, monkeypatch):
    # fails if a motion that turns over for an hour ends a fit with an internal error of linear algebra
    plain = ShootingProblem.normal_equations

    def overflowed(*given, **how):
        cost, A, b = plain(*given, **how)
        return cost, replace(A, blocks=A.blocks / 0), b

    monkeypatch.setattr(ShootingProblem, "normal_equations", overflowed)
    with pytest.raises(InputError, match="so unstable that its derivatives overflow"):
        laplace(posteriors[0][0])


def test_standard_deviation_of_the_damping_rate(posteriors):
    # fails if the covariance is off by the noise: γ = 0.2 must lie within a few of its own standard deviations
    scores = []
    for run, posterior, _ in posteriors:
        std = float(posterior.standard_deviations()["damping.rate"])
        assert 1e-4 < std < 0.02
        scores.append(abs(run.metrics["rate"] - 0.2) / std)
    assert sorted(scores)[1] < 2.0
    assert max(scores) < 5.0


@pytest.mark.parametrize(("worst", "factor"), [
    ((1e3, 1.0, 1.0), 1.0), ((1e3, 2.0, 2.0), 2.0), ((0.5, 0.5, 0.5), 1.0), ((INF, 1.0, 1.0), 1.0),
    ((INF, INF, 1.0), INF),
])  # fmt: skip
def test_a_block_that_alone_tells_a_number_widens_no_band(posteriors, monkeypatch, worst, factor):
    # fails if the error of a block that nothing else foretells, 4500 times the noise where motion dies out within five
    # periods of eight samples, is the factor of all deviations: the equation had no number left
    run, _, _ = posteriors[0]
    sigma = run.metrics["sigma"]
    monkeypatch.setattr(uncertainty, "held_out_errors", lambda *_: sigma * torch.tensor([1.0, *worst, worst[-1]]))
    assert laplace(run).inflation == pytest.approx(factor)


def test_prediction_from_the_beginning_is_the_posterior(posteriors):
    # fails if the start's dependence on the parameters is left out or has the wrong sign: with what the fit has seen,
    # the two blocks of the posterior come back by the inverse of a block matrix
    run, posterior, _ = posteriors[0]
    (trained,) = set(run.train_lengths)
    own, again = posterior.bands(), posterior.predict(run.data, trained)
    torch.testing.assert_close(again.q, own.q, rtol=0, atol=0.03 * NOISE)  # the fit stops at 1e-4 of its cost
    torch.testing.assert_close(again.std, own.std, rtol=0.01, atol=0)


def test_what_cannot_be_predicted_is_named(posteriors):
    # fails if nothing is left to predict, or another system is taken for the run's
    run, posterior, _ = posteriors[0]
    with pytest.raises(InputError, match="seen must be from 3 to 90 samples, got 91"):
        posterior.predict(run.data, 91)
    other = simulate(scene("damped_oscillator"), trajectories=1, steps=40, h=0.2, seed=0)
    with pytest.raises(InputError, match="the run's are "):
        posterior.predict(other, 20)


@pytest.mark.slow
def test_bands_cover_held_out_trajectories():
    # fails if bands from unseen starts are too narrow or too wide, for a sample or for the true position
    shares = []
    for seed in range(5):
        data = simulate(scene("damped_pendulum"), trajectories=12, steps=60, h=0.2, noise=NOISE, seed=seed)
        posterior = laplace(fit(data, FitConfig(train_fraction=1.0, seed=seed), progress=False))
        noisy, clean = (
            simulate(
                scene("damped_pendulum"), trajectories=20, steps=119, h=0.2, noise=noise, seed=seed + 500
            ).unwrapped()
            for noise in (NOISE, 0.0)
        )
        bands, ahead = posterior.predict(noisy, 20), torch.arange(noisy.samples) % 120 >= 20
        low, high = bands.interval(0.9, measured=False)
        true = (clean.q >= low) & (clean.q <= high)
        shares.append([float(x[ahead].double().mean()) for x in (bands.inside(noisy.q), true)])
    assert all(0.80 <= measured <= 0.97 for measured, _ in shares), shares
    assert 0.80 <= sum(true for _, true in shares) / len(shares) <= 0.97, shares


def test_the_level_is_checked(posteriors):
    # fails if a percentage is taken for a share
    with pytest.raises(InputError, match="between 0 and 1"):
        posteriors[0][1].bands().interval(90)


def test_bands_of_seeds(posteriors):
    # fails if the spread of the seeds, or each seed's own variance, is left out; or runs of other data are mixed in
    run, posterior, _ = posteriors[0]
    other = fit(run.data, replace(SETTINGS, seed=7), progress=False)
    bands = ensemble_bands([run, other])
    inside = bands.inside(run.data.q)[held_out(run)].double().mean()
    assert 0.75 <= float(inside) <= 1.0
    own, theirs = posterior.bands(), laplace(other).bands()
    wanted = (own.std.square() + theirs.std.square()) / 2 + (own.q - theirs.q).square() / 2
    torch.testing.assert_close(bands.std.square(), wanted)
    torch.testing.assert_close(bands.q, (own.q + theirs.q) / 2)
    with pytest.raises(InputError, match="two runs or more, got 1"):
        ensemble_bands([run])
    with pytest.raises(InputError, match="fits to the same data"):
        ensemble_bands([run, posteriors[1][0]])
