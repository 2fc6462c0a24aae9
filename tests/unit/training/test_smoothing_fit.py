"""Joint smoothing: exact derivatives, elimination of the states, both noises found, the model behind pushed motion."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, Prior, SmoothingProblem, fit
from herglotz.training.arrowhead import Arrowhead, eliminated
from herglotz.training.cross_validation import _left_out, left_out_errors
from herglotz.training.problems.grid import segment_grid
from herglotz.training.smoother import ROUNDS

NOISE = 0.01
RTOL = 1e-10  # of the largest entry; differences and closed forms differ by 2e-14 to 3e-12 (AVX-512, AVX2, SSE)


def problem_of(level="linear", n=1, freedom=None):
    """A problem over two trajectories of different lengths with a gap, away from its minimum; and unknowns."""
    sizes: dict[str, Any] = {"scale": (1.5,) * n, "speed": (1.2,) * n, "stiffness": (1.0,) * n, "tilt": (0.0,) * n}
    angles = tuple(i == 0 for i in range(n))
    model = ContactLagrangian(
        ModelConfig(angles=angles, level=level, rate=0.2, potential_width=2, damping_width=2, **sizes)
    )
    make = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in model.parameters():
            p += 0.1 * torch.randn(p.shape, generator=make, dtype=p.dtype)
    t = torch.tensor([0.0, 0.2, 0.4, 0.8, 1.0, 0.0, 0.2, 0.45, 0.6], dtype=torch.float64)
    q = torch.randn(9, n, generator=make, dtype=torch.float64).cumsum(0) * 0.2
    data = Trajectories.of(t, q, (5, 4), angles=angles)
    prior = Prior(model, q.amin(0), q.amax(0), departure=0.1, weight=1.0, rate_spread=0.1)
    problem = SmoothingProblem(
        model, data, segment_grid(data, 9, 0.3), sigma=0.1, process=0.5, prior=prior, freedom=freedom
    )
    x = problem.start()
    return problem, x + 0.02 * torch.randn(x.shape, generator=make, dtype=x.dtype)


def slope(f, eps=1e-3):
    """f′(0) by differences of sixth order: truncation eps⁶ f⁽⁷⁾/140, rounding 1e-16/eps."""
    by = {1: 45.0, 2: -9.0, 3: 1.0}
    differences = [w * (f(k * eps) - f(-k * eps)) for k, w in by.items()]
    return torch.stack(differences).sum(0) / (60 * eps)


def dense(matrix):
    """The matrix as a tensor, by its products."""
    return torch.stack([matrix @ e for e in torch.eye(len(matrix.diagonal()), dtype=torch.float64)], 1)


@pytest.mark.parametrize(("level", "n"), [("linear", 1), ("affine", 2)])
def test_normal_equations_match_finite_differences(level, n):
    # fails if a block, the border, the anchor of s, the prior, the padding or a weight is wrong
    problem, x = problem_of(level, n)
    cost, A, b = problem.normal_equations(x)
    assert float(cost) == pytest.approx(float(problem.cost(x)), rel=1e-12)

    def residuals(x):
        theta, states = problem.unpack(x)
        stepped = problem._stepped(x)
        assert stepped is not None
        assert problem.prior is not None
        fit, defect = problem._residuals(states, stepped[0])
        return torch.cat([fit.flatten(), defect.flatten(), problem._anchor(states), problem.prior.residuals(theta)])

    # Along random directions, in which every entry has its share: by unknowns it takes ten times as long.
    D = torch.randn(len(x), 8, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    J = torch.stack([slope(lambda t, d=d: residuals(x + t * d)) for d in D.T], 1)
    torch.testing.assert_close(D.T @ b, J.T @ residuals(x), rtol=RTOL, atol=RTOL * float((D.T @ b).abs().max()))
    padding = torch.cat([torch.zeros(problem.P).to(x), (1 - problem.inside).expand(-1, -1, problem.d).flatten()])
    assert int(padding.sum()) == 2 * problem.d  # two nodes of the shorter trajectory
    expected = J.T @ J + D.T @ (padding[:, None] * D)
    found = D.T @ torch.stack([A @ d for d in D.T], 1)
    torch.testing.assert_close(found, expected, rtol=RTOL, atol=RTOL * float(expected.abs().max()))


def test_gradient_of_the_robust_loss():
    # fails if Student's weights are not those of the loss; it bends within 1e-3: a shorter step, off by 3e-12 to 8e-12
    problem, x = problem_of(freedom=4.0)
    _, _, b = problem.normal_equations(x)
    D = torch.randn(8, len(x), generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    D /= D.norm(dim=1, keepdim=True)
    slopes = torch.stack([slope(lambda t, d=d: problem.cost(x + t * d), 5e-5) for d in D])
    torch.testing.assert_close(D @ b, slopes, rtol=RTOL, atol=RTOL * float(b.abs().max()))


def test_elimination_solves_the_whole_system():
    # fails if the border is eliminated with a wrong sign, or damping misses a part
    problem, x = problem_of("affine")
    _, A, b = problem.normal_equations(x)
    matrix, damping = dense(A), 0.1 * A.diagonal()
    torch.testing.assert_close(A.diagonal(), matrix.diagonal())
    torch.testing.assert_close(A.solve(b, damping), torch.linalg.solve(matrix + torch.diag(damping), b))


@pytest.mark.parametrize("driven", [False, True])
def test_left_out_errors_are_those_of_fits_without_the_fold(driven):
    # fails if the residuals of a fold are not freed of their own pull: least squares is the exact case
    make = torch.Generator().manual_seed(0)
    J, y = (torch.randn(20, *shape, generator=make, dtype=torch.float64) for shape in ((3,), ()))
    u = torch.ones(20, 1, dtype=torch.float64) if driven else None
    data = Trajectories.of(torch.arange(20, dtype=torch.float64), y[:, None], (20,), u=u)
    # The last two unknowns are a start.
    A, none = J.T @ J, torch.zeros(1, 2, 2, dtype=torch.float64)
    matrix = Arrowhead(A[:1, :1], A[1:, :1][None], A[1:, 1:][None], none, eliminated)
    r, segment = (J @ torch.linalg.solve(A, J.T @ y) - y)[:, None], torch.zeros(20, dtype=torch.long)
    found = left_out_errors(r, data, lambda rows: _left_out(matrix, J[:, None], r, segment, rows))
    fold = torch.arange(20) // 4
    if driven:
        fold[:2] = -1  # the first samples, half of their fold here, are never left out
    for k in range(5):
        without = torch.linalg.lstsq(J[fold != k], y[fold != k, None]).solution[:, 0]
        expected = (J[fold == k] @ without - y[fold == k]).square().mean().sqrt()
        torch.testing.assert_close(found[k], expected)


def disturbed(kick, seed=0, count=6, steps=60):
    """Noisy positions of the damped pendulum under random pushes."""
    make = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=make, dtype=torch.float64)  # noqa: E731
    sizes: dict[str, Any] = {"scale": (1.5,), "speed": (1.2,), "stiffness": (1.0,)}
    truth = Stepper(
        ContactLagrangian(ModelConfig(level="linear", rate=0.2, potential_width=0, damping_width=0, **sizes))
    )
    q, p, out = draw(count, 1), draw(count, 1), []
    with torch.no_grad():
        for _ in range(steps + 1):
            out.append(q)
            run = truth.rollout(q, p, h=0.1, steps=2)
            q, p = run.q[:, -1], run.p[:, -1] + kick * draw(count, 1)
    x = torch.stack(out, 1)
    t = (0.2 * torch.arange(steps + 1, dtype=x.dtype)).repeat(count)
    return Trajectories.of(t, (x + NOISE * draw(*x.shape)).flatten(0, 1), (steps + 1,) * count, angles=(True,))


def test_both_noises_are_found():
    # fails if the pushes are taken for noise of the data (trajectories that must not leave the model do: 0.037), or the
    # rounds go on when both noises have settled
    data = disturbed(kick=0.02)
    run = fit(data, FitConfig(objective="smoothing", train_fraction=1.0, departures=(2e-3,)), progress=False)
    model = run.model.config
    process = run.metrics["process"] * run.metrics["sigma"] * model.speed[0] / model.scale[0]
    assert run.metrics["objective"] == "smoothing"
    rounds = {row["stage"] for row in run.history if "noise" in row["stage"]}
    assert 2 <= len(rounds) < ROUNDS
    assert run.metrics["sigma"] == pytest.approx(NOISE, rel=0.1)
    assert process == pytest.approx(0.02, rel=0.3)
    assert run.metrics["rate"] == pytest.approx(0.2, rel=0.3)


def test_undisturbed_motion_is_left_to_the_model():
    # fails if the steps' noise does not fall, or the held-out part is not predicted from the last smoothed state
    data = simulate(scene("damped_pendulum"), trajectories=4, steps=60, h=0.2, noise=NOISE, seed=0)
    run = fit(data, FitConfig(objective="smoothing", departures=(2e-4, 2e-3)), progress=False)
    assert run.metrics["process"] < 0.1
    assert run.metrics["follows_data"]
    assert run.metrics["departure"] == 2e-3
    assert run.metrics["extrapolation_rms"] < 2 * NOISE
    assert run.metrics["sigma"] == pytest.approx(NOISE, rel=0.15)
    assert bool(torch.isfinite(torch.cat([x.flatten() for x in run.states])).all())


def test_pushes_of_some_steps_are_outweighed():
    # fails if the loss stays quadratic where a few steps leave the model by far
    data = simulate(scene("damped_pendulum"), trajectories=3, steps=40, h=0.2, noise=NOISE, seed=1)
    jump = torch.zeros_like(data.q)
    for first in data.offsets:
        jump[first + 30] = 1.0
    settings = FitConfig(objective="smoothing", train_fraction=1.0, departures=(2e-3,), robust="on")
    run = fit(replace(data, q=data.q + jump), settings, progress=False)
    assert run.metrics["robust"]
    assert run.metrics["rate"] == pytest.approx(0.2, rel=0.1)
