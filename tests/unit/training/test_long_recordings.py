"""Long recordings of driven machines: the part a search begins with, segments, and errors of held-out time."""

from typing import TypeVar

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.data.noise import part_of
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, Prior, ShootingProblem
from herglotz.training.baseline import estimate_baseline
from herglotz.training.cross_validation import held_out_errors
from herglotz.training.problems.grid import segment_grid, segment_lengths
from herglotz.training.search import Search
from herglotz.training.trials import Variant

T = TypeVar("T")


def there(found: T | None) -> T:
    assert found is not None
    return found


def line(lengths):
    t = torch.cat([torch.arange(n, dtype=torch.float64) / 10 for n in lengths])
    return Trajectories.of(t, t.sin(), tuple(lengths))


@pytest.mark.parametrize("lengths", [(31,), (1400, 60), (6670,), (20,)])
def test_the_longest_segments_are_the_only_whole_trajectories(lengths):
    # fails if a length above two thirds of a trajectory fits the whole of it, and the last stage fits it again
    found = segment_lengths(line(lengths))
    pieces = [max(1, round((max(lengths) - 1) / length)) for length in found]
    assert pieces[-1] == 1
    assert 1 not in pieces[:-1]


def test_the_liveliest_part_is_where_the_motion_is():
    # fails if a search begins with the seconds before the machine starts, or with a part of another trajectory
    t = torch.arange(3000, dtype=torch.float64) / 100
    q = torch.where((t > 12) & (t < 20), (5 * t).sin(), 1e-3 * t.sin())
    part = Trajectories.of(t, q).liveliest(500)
    assert part.samples == 500
    assert 11.9 < float(part.t[0]) < float(part.t[-1]) < 20.1
    many = line([900] * 20)
    assert many.liveliest(2000).lengths == (200,) * 10
    assert many.liveliest(20_000) is many


def test_a_part_of_fast_samples_is_every_mth_of_all():
    # fails if a search is made of a few turns of many, of steps that the motion is too fast for, or of short recordings
    # with next to no samples left
    noise = 1e-3 * torch.randn(8000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for h, longer in ((0.02, 8), (0.4, 1)):  # 314 and 16 samples a turn
        t = h * torch.arange(8000, dtype=torch.float64)
        part = part_of(Trajectories.of(t, t.sin() + noise), 1000)[0]
        assert part.typical_step == pytest.approx(longer * h)
        assert part.samples == 1000
    few = line([900] * 3)
    assert part_of(few, 1400)[0] is few
    many = line([90] * 100)
    assert part_of(many, 1000)[0].typical_step == pytest.approx(0.1)


def long_drive(**more):
    """Two recordings of 9000 samples of a slow motion with inputs that change at every sample."""
    t = torch.cat([0.02 * torch.arange(9000, dtype=torch.float64)] * 2)
    make = torch.Generator().manual_seed(0)
    noise, u = (torch.randn(18_000, generator=make, dtype=torch.float64) for _ in range(2))
    return Trajectories.of(t, t.sin() + 1e-3 * noise, (9000, 9000), u=u, **more)


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_model_steps_of_a_part_have_the_inputs_that_were_recorded_in_them(hold):
    # fails if every model step of a part has the mean of the long step that it lies in, if a hold of the inputs is that
    # of these means, or if the rows of the second recording are those of the first
    data = long_drive(hold=hold)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    part, rows = there(search.part.every)
    assert part is data
    assert torch.equal(data.t[rows], search.part.data.t)
    assert len(search.part.data) == 2
    m = round(search.part.step_ratio)
    assert m == 8
    fitter = search.part.fitter(Variant(2, substeps=m))
    grid, u = fitter.grids.of(20, fitter.base.model_step)
    k = rows[grid.row] + (m * grid.part).long()
    expected = there(data.u)[k] if hold == "zero" else (there(data.u)[k] + there(data.u)[k + 1]) / 2
    assert torch.allclose(there(u), expected, rtol=1e-9, atol=1e-9)
    coarse = search.part.fitter(Variant(2))
    grid, u = coarse.grids.of(20, coarse.base.model_step)
    at = rows[grid.row]
    means = torch.stack([there(data.inputs_of_steps())[at + j] for j in range(m)]).mean(0)
    assert torch.allclose(there(u), means, rtol=1e-9, atol=1e-9)


def test_a_part_has_the_hold_of_the_recording_and_its_terms_of_inputs():
    # fails if a part of long steps is not asked for another hold, or its u^2 are squares of means
    data = long_drive(hold="zero")
    search = Search(data, estimate_baseline(data), FitConfig(level="forced").resolved(data)).part
    assert (search.hold, search.held("first").hold) == ("zero", "first")
    assert search.held("first").data is not search.data  # whose fits are made anew
    driven = search.driven_by(["u^2"])
    fitter = driven.fitter(Variant(2, substeps=8))
    u = there(fitter.grids.of(20, fitter.base.model_step)[1])
    assert torch.allclose(u[..., 1], u[..., 0].square(), atol=1e-9)


def test_model_steps_are_about_as_long_in_a_part_and_in_all():
    # fails if samples far apart are crossed in as many steps as there are samples between, or all samples in as many
    # steps as the part needed between two of its own
    t = 0.02 * torch.arange(9000, dtype=torch.float64)
    noise = 1e-3 * torch.randn(9000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = Trajectories.of(t, t.sin() + noise)
    search = Search(data, estimate_baseline(data), FitConfig().resolved(data))
    m = search.part.step_ratio
    assert m == pytest.approx(4)
    assert search.part.base.max_step == pytest.approx(m * search.base.max_step)
    assert search.part.base.model_step == pytest.approx(m * search.base.model_step)
    assert [Variant(2, substeps=n).crossing(1 / m).substeps for n in (1, 4, 8)] == [1, 1, 2]


def test_held_out_time_at_the_start_is_predicted_from_its_start():
    # fails if the first block has to tell its start from what comes after: friction has forgotten it by then, and the
    # error grows as e^{γT/5} (7e11 times the noise here), so that no other block has a say
    make = torch.Generator().manual_seed(0)
    K, h, noise = 200, 0.1, 1e-3
    model = ContactLagrangian(
        ModelConfig(level="forced", inputs=1, input_map=(1.0,), stiffness=(1.0,), potential_width=0)
    )
    assert model.friction is not None
    model.friction.viscous.data.fill_(6.0)
    u = torch.randn(1, K + 1, 1, generator=make, dtype=torch.float64).cumsum(1)
    q0 = torch.zeros(1, 1, dtype=torch.float64)
    with torch.no_grad():
        out = Stepper(model).rollout(q0, q0, q0[:, 0], h=h, steps=K, inputs=u[:, :-1])
    q = out.q[0] + noise * torch.randn(K + 1, 1, generator=make, dtype=torch.float64)
    data = Trajectories.of(torch.arange(K + 1, dtype=torch.float64) * h, q, u=u[0])
    prior = Prior(model, data.q.amin(0), data.q.amax(0), departure=None)
    problem = ShootingProblem(model, data, segment_grid(data, K, 1.5 * h), sigma=noise, prior=prior)
    theta = problem.parameters.get()
    problem.path = problem.solve(problem.pack(theta, problem.states(q0, q0)))
    assert problem.path is not None
    _, A, _ = problem.normal_equations(problem.pack(theta, problem.states(q0, q0)))
    errors = held_out_errors(problem, problem.path, theta, A)
    assert float(errors.max()) < 10 * noise  # largest of ten seeds: 2.2
