"""The parts of `tune`: bounds, fronts, starts, references, distillation and timing, on a run made by hand."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.progress import ProgressBar
from herglotz.stepping import State, Stepper
from herglotz.training import FitConfig, Run
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.recorded_range import box_of
from herglotz.tune import Candidate, Setting, TuneConfig, distil, pareto, search, tune
from herglotz.tune.cost import Cost, Timed, measure_costs
from herglotz.tune.distil import distillation, pairs_of, widened
from herglotz.tune.local_error import flag_unresolved, local_errors
from herglotz.tune.result import allowed_failures
from herglotz.tune.search import JITTER, bound_of, choose, draw_starts, record

H = 0.2
FAST = TuneConfig(multiples=(1, 2), widths=(), artefacts=("eager",), tolerances=(None,), starts=60, rounds=1)


def run_of(level="linear", width=0, dtype=torch.float64):
    """A run whose model is its own truth: 4 motions of 13 samples."""
    config = ModelConfig(
        level=level, speed=(1.5,), scale=(2.0,), rate=0.2, potential_width=0, damping_width=4, correction_width=width
    )
    model = ContactLagrangian(config)
    q = torch.linspace(-1.5, 1.5, 4, dtype=torch.float64)[:, None]
    with torch.no_grad():
        out = Stepper(model).rollout(q, 0.5 * torch.cos(3 * q), h=H, steps=12)
    t = (H * torch.arange(13, dtype=torch.float64)).repeat(4)
    states = State(out.q.flatten(0, 1), out.p.flatten(0, 1), out.s.flatten())
    data = Trajectories.of(t, states.q, (13,) * 4, angles=(True,), time_unit="s", source="by hand")
    fitted = FitConfig(level=level, dtype=str(dtype).removeprefix("torch."))
    return Run(model.to(dtype), fitted, {"train_rms": 0.0}, data, data.lengths, states, H, box_of(*states), [])


def candidate(us, bound, h=1.0):
    setting = Setting(1, h, None, "eager", "float64", None)
    return Candidate(setting, bound, bound, bound, Cost(us * h, 0.0), ContactLagrangian(ModelConfig()))


@pytest.mark.parametrize(("count", "allowed"), [(59, 0), (92, 0), (93, 1), (123, 1), (124, 2), (128, 2)])
def test_tolerance_limits_are_those_of_the_tables(count, allowed):
    # fails if the bound promises more than its starts can show (one-sided limits 95 %/95 %: 59, 93, 124, ...)
    assert allowed_failures(count, 0.95, 0.95) == allowed


def test_bound_keeps_its_promise_over_many_draws():
    # fails if the order statistic is off by one: the share of draws whose bound covers 95 % must be 95 % or more
    generator = torch.Generator().manual_seed(0)
    bounds = [bound_of(torch.rand(128, generator=generator), TuneConfig()) for _ in range(2000)]
    share = sum(b >= 0.95 for b in bounds) / 2000
    assert 0.95 <= share <= 0.975


def test_too_few_starts_are_refused():
    # fails if 20 starts are taken to prove a 95 % bound
    with pytest.raises(InputError, match="take 59 or more"):
        TuneConfig(starts=20)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"multiples": (0.5,)}, "whole numbers"),
        ({"multiples": ()}, "empty"),
        ({"widths": (0,)}, "widths must be >= 1"),
        ({"artefacts": ("rust",)}, "artefacts must be some of"),
        ({"quantile": 1.0}, "quantile must be in"),
        ({"rounds": 0}, "rounds must be >= 1"),
    ],
)
def test_wrong_settings_are_named(wrong, words):
    # fails if a setting is accepted that the search cannot honour
    with pytest.raises(InputError, match=words):
        TuneConfig(**wrong)


def test_front_holds_what_nothing_beats():
    # fails if a beaten or a failed setting is on the front, or a tie in cost keeps the worse
    cheap, better, beaten, failed, tie = (
        candidate(*x) for x in [(1, 1e-1), (2, 1e-3), (3, 1e-2), (0.5, float("inf")), (2, 1e-2)]
    )
    assert pareto([beaten, tie, better, failed, cheap]) == [cheap, better]


def test_choice_meets_the_demand_or_says_what_can_be_had():
    # fails if the cheapest replaces the most accurate, or the cost is that of a step, not of a unit of time
    rough, fine = candidate(1.0, 1e-2, h=4.0), candidate(2.0, 1e-4, h=0.5)
    assert choose([fine, rough], {"max_error": 2e-2}) is rough
    assert choose([fine, rough], {"max_error": 1e-3}) is fine
    # A step of `fine` costs less, a unit of time more.
    assert choose([fine, rough], {"budget_us": 1.5}) is rough
    assert choose([fine, rough], {"budget_us": 5.0}) is fine
    with pytest.raises(InputError, match=r"smallest bound found is 0\.0001"):
        choose([fine, rough], {"max_error": 1e-5})
    with pytest.raises(InputError, match="cheapest found takes 1 "):
        choose([fine, rough], {"budget_us": 0.5})


def test_starts_lie_in_the_box_and_differ_with_the_seed():
    # fails if a start leaves the box, copies a recorded state, or the judges are the choosers
    run = run_of()
    a, b = draw_starts(run, 60, 0), draw_starts(run, 60, 1)
    for name, x in zip("qps", a, strict=True):
        low, high = run.box[f"{name}_low"][0], run.box[f"{name}_high"][0]
        assert bool(((x >= low) & (x <= high)).all())
    assert not torch.equal(a.q, b.q)
    assert torch.equal(a.q, draw_starts(run, 60, 0).q)
    assert not torch.isin(a.q, run.states.q).all()


def test_starts_lie_on_both_sides_of_recorded_states():
    # fails if states are moved in one direction only, or too far
    run = run_of()
    still = replace(run, states=State(*(torch.zeros_like(x) for x in run.states)))
    for name, x in zip("qp", draw_starts(still, 60, 0), strict=False):
        most = JITTER * (run.box[f"{name}_high"][0] - run.box[f"{name}_low"][0])
        assert float(x.min()) < -0.8 * most
        assert 0.8 * most < float(x.max()) <= most


def test_local_errors_are_those_of_two_half_steps():
    # fails if a list of steps is taken for one step, a scalar for a list, or the error is not relative to the move
    stepper, start = Stepper(run_of().model), torch.tensor([[0.7]], dtype=torch.float64)
    steps = torch.tensor([0.1, 0.4, 0.2], dtype=torch.float64)
    with torch.no_grad():
        out, even = stepper.rollout(start, start, h=steps), stepper.rollout(start, start, h=H, steps=3)
        for rollout, sizes in ((out, steps), (even, torch.full_like(steps, H))):
            found = local_errors(stepper, rollout, steps if rollout is out else H)
            for k, h in enumerate(sizes.tolist()):
                half = stepper.rollout(rollout.q[:, k], rollout.p[:, k], rollout.s[:, k], h=h / 2, steps=2).q[0, 2, 0]
                q0, q1 = rollout.q[0, k : k + 2, 0]
                assert float(found[0, k]) == pytest.approx(float((q1 - half).abs() / max(abs(q1 - q0), abs(half - q0))))
    with pytest.raises(InputError, match="h lists 2 steps, but 3 were kept"):
        local_errors(stepper, out, steps[:2])
    assert flag_unresolved(stepper, out, steps, float(found.max()) / 2).status.max() > 0
    assert flag_unresolved(stepper, out, steps, 1.0).status.max() == 0


def test_a_flow_of_the_model_itself_has_no_residual():
    # fails if a residual of the distillation is not zero at the model that made the motions
    run = run_of("affine")
    motions = record(run, draw_starts(run, 8, 0), 2.4)
    problem = distillation(run.model, *pairs_of(motions.states, 1, 40, 0), H)
    assert float(problem.residuals(ParameterVector(run.model).get()).abs().max()) < 1e-13
    moved = ParameterVector(run.model).get() + 1e-3
    assert float(problem.residuals(moved).abs().max()) > 1e-5


@pytest.mark.parametrize(("part", "column"), [(1, 1), (2, 2)])
def test_each_part_of_the_state_has_its_residual(part, column):
    # fails if p or s of the second state are not asked for
    run = run_of()
    motions = record(run, draw_starts(run, 8, 0), 2.4)
    before, after = pairs_of(motions.states, 1, 20, 0)
    wrong = State(*(x + 1e-3 * (k == part) for k, x in enumerate(after)))
    problem = distillation(run.model, before, wrong, H)
    found = problem.residuals(ParameterVector(run.model).get()).abs().amin(0) > 1e-5
    assert found.tolist() == [k == column for k in range(3)]


def test_distilled_model_steps_two_at_a_time_in_the_same_coordinates():
    # fails if p or s are left out of the objective: the states of the run would mean something else to the new model
    run = run_of()
    motions = record(run, draw_starts(run, 60, 0), 2.4)
    before, after = pairs_of(motions.states, 2, 200, 0)
    model, rms = distil(widened(run.model, 6), before, after, 2 * H, iterations=100)
    assert rms < 1e-5
    with torch.no_grad():
        one, plain = (Stepper(m).step(before, 2 * H).state for m in (model, run.model))
    for a, b, c in zip(one, plain, after, strict=True):
        assert float((a - c).abs().median()) < 0.02 * float((b - c).abs().median())


def test_widened_keeps_what_it_can():
    # fails if a correction of the same size is thrown away, or a new correction changes the model before training
    run, last = run_of(width=4), "correction.network.weights.2"
    with torch.no_grad():
        run.model.get_parameter(last).add_(0.1)
    same, wider = widened(run.model, 4), widened(run.model, 6)
    assert torch.equal(same.get_parameter(last), run.model.get_parameter(last))
    assert float(wider.get_parameter(last).detach().abs().max()) == 0.0
    assert torch.equal(wider.potential.stiffness, run.model.potential.stiffness)


def test_idle_calls_are_not_counted():
    # fails if a step costs the call around the steps, or the rounds are added up
    from time import sleep

    work = Timed(lambda: sleep(0.02), 2, lambda: sleep(0.01))
    (cost,) = measure_costs([work], 3)
    assert 4000 < cost.step_us < 8000


def test_the_run_as_it_is_costs_no_error():
    # fails if the reference is another motion than the run's own, or errors are taken at other times
    found = tune(run_of(), max_error=1e-9, config=FAST, progress=False)
    assert found.own.worst < 1e-13
    assert found.chosen is found.own
    # Twice the step with the same model has the error of the rule.
    assert found.candidates[1].median > 1e-4
    assert found.held_out["share_within"] == 1.0
    # fails if the table is wider than a terminal of 80 columns
    assert max(map(len, found.table().splitlines())) <= 80


def test_the_run_as_it_is_is_tried_whatever_was_asked_for(monkeypatch):
    # fails if the eager run, which the others are compared with, is left out where artefacts are C alone, or if other
    # steps are tried in eager then
    monkeypatch.setattr(search._Search, "_in_c", lambda *_: iter(()))
    run, config = run_of(), replace(FAST, artefacts=("c",))
    training, choosing = (record(run, draw_starts(run, 60, seed), 10 * H) for seed in range(2))
    with ProgressBar(disable=True) as bar:
        tried = search._Search(run, search.frozen_double(run), config, 1.0, training, choosing, [], bar)
        assert [(x.setting.multiple, x.setting.artefact) for x in tried.forms()] == [(1, "eager")]


@pytest.mark.parametrize(("progress", "disable"), [(True, False), (False, True), (None, None)])
def test_the_bar_is_shown_as_asked_for(progress, disable, monkeypatch):
    # fails if progress=True shows no bar, or None does not leave the choice to the terminal
    class Asked(Exception):
        pass

    def asked(**options):
        assert options["disable"] is disable
        raise Asked

    monkeypatch.setattr(search, "ProgressBar", asked)
    with pytest.raises(Asked):
        tune(run_of(), max_error=0.5, config=FAST, progress=progress)


def test_tuned_run_holds_the_chosen_step(tmp_path):
    # fails if the saved run loses the step, the states or the precision that were chosen
    from herglotz.training import load_run, save_run

    found = tune(run_of(), max_error=0.5, config=FAST, progress=False)
    picked = replace(found, chosen=found.candidates[1], motions=State(*(x[:, ::2] for x in found.motions)))
    save_run(picked.tuned_run(), tmp_path / "run")
    again = load_run(tmp_path / "run")
    assert again.h == pytest.approx(2 * H)
    assert again.data.typical_step == pytest.approx(2 * H)
    assert again.metrics["tuned"]["chosen"]["multiple"] == 2


@pytest.mark.parametrize(
    ("demand", "words"),
    [
        ({}, "either --max-error or --budget-us"),
        ({"max_error": 1.0, "budget_us": 1.0}, "either --max-error or --budget-us"),
        ({"max_error": -1.0}, "max_error must be a finite number > 0"),
        ({"max_error": 1.0, "horizon": 0.3}, "shorter than two of the largest steps"),
    ],
)
def test_wrong_demands_are_named(demand, words):
    # fails if a demand that cannot be met is searched for minutes first
    with pytest.raises(InputError, match=words):
        tune(run_of(), config=FAST, **demand)
