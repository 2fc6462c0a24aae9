"""The plan of a fit: chosen with reasons, stored, followed again, drawn in the docs."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from herglotz.data import simulate
from herglotz.errors import InputError
from herglotz.scenes import scene
from herglotz.training import FitConfig, Plan, choose, fit, look
from herglotz.training.choose import RULES, answers, choose_objective
from herglotz.training.plan import WORDS, in_words as plan_in_words
from herglotz.training.stages import Stages

DOCS = Path(__file__).resolve().parents[3] / "docs" / "trajectory.md"
QUICK = FitConfig(iterations=15, departures=(2e-3,))


@cache
def pendulum(noise=0.0, trajectories=3, steps=40, state=False):
    return simulate(
        scene("damped_pendulum"), trajectories=trajectories, steps=steps, h=0.2, noise=noise, seed=3, keep_state=state
    )


@cache
def seen(noise=0.0, **settings):
    """The look at a pendulum, and the settings."""
    config = replace(QUICK, **settings)
    data = pendulum(noise, state=config.supervision != "q")
    return look(data, config, Stages(False, None, "", resume=False)), config


def drawing():
    """The choice of the objective as a mermaid flowchart."""
    lines = ["flowchart TD", '    look["look: spikes, outliers, noise, baseline, structure, probe"] --> q1']
    for k, (question, objective) in enumerate(RULES.items(), 1):
        if k == len(RULES):
            lines.append(f'    q{k}["{question.lower()}"] --> o{k}(["{objective}"])')
        else:
            lines.append(f'    q{k}{{"{question}"}} -- yes --> o{k}(["{objective}"])')
            lines.append(f"    q{k} -- no --> q{k + 1}")
    return "\n".join(lines)


def test_the_drawing_in_the_docs_is_the_code():
    # fails if a rule of the objective is added, dropped or moved and docs/trajectory.md still shows the old ones
    assert drawing() in DOCS.read_text(encoding="utf-8")


@pytest.mark.parametrize(("noise", "settings", "number", "objective"), [
    (0.0, {}, 3, "trajectory"), (0.0, {"level": "linear"}, 6, "residual"), (0.01, {}, 3, "trajectory"),
    (0.0, {"sticking": True}, 2, "trajectory"), (0.01, {"objective": "smoothing"}, 1, "smoothing"),
    (0.0, {"mass_width": 3}, 8, "trajectory"), (0.0, {"supervision": "qs"}, 0, "residual"),
])  # fmt: skip
def test_the_first_rule_that_is_answered_decides(noise, settings, number, objective):
    # fails if a rule is skipped, asked in another order, or gives another objective
    found, config = seen(noise, **settings)
    assert next(k for k, reason in enumerate(answers(found, config)) if reason) == number
    assert choose_objective(found, config)[0] == objective


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_every_decision_has_a_reason(noise):
    # fails if a field is added to the plan and nobody says why it has its value
    plan = choose(*seen(noise))
    assert set(plan.reasons) == {*WORDS, "start"}
    assert all(plan.reasons.values())
    table = plan.table()
    told = [WORDS[name] for name in ("level", "objective", "network", "order", "features", "forces", "outliers")]
    assert all(f"{words}: " in " ".join(table.split()) for words in told)
    assert (WORDS["departures"] in table) == (WORDS["network"] + ": none" not in table)
    assert max(map(len, table.splitlines())) <= 80


@pytest.mark.parametrize(
    ("noise", "settings"),
    [(0.01, {}), (0.0, {}), pytest.param(0.0, {"mass_width": 2, "correction_width": 3}, marks=pytest.mark.slow)],
)
def test_a_plan_that_is_given_back_repeats_the_fit(noise, settings):
    # fails if a decision is not in the plan, is lost in JSON, or is made again by other means
    config, data = replace(QUICK, **settings), pendulum(noise)
    first = fit(data, config, progress=False)
    plan = Plan.from_dict(json.loads(json.dumps(first.metrics["plan"])))
    again = fit(data, config, plan=plan, progress=False)
    assert again.metrics["plan"] == first.metrics["plan"]
    one, other = (torch.nn.utils.parameters_to_vector(run.model.parameters()) for run in (first, again))
    torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)  # equal but for the last bits of long sums


def test_the_noise_that_the_first_stage_assumes():
    # fails if the error of q2 − 2 q1 + q0 is taken for the noise, or multiplied by √6: 6 times the noise of 0.01
    found, config = seen(0.01, level="linear")
    for enough in (True, False):
        probe: Any = SimpleNamespace(**vars(found.probe), enough=enough)
        sigma = choose(replace(found, probe=probe), config).sigma
        assert sigma == (pytest.approx(0.01, rel=0.5) if enough else None)


def test_a_plan_overrules_the_choice():
    # fails if the data are asked again although a plan is given
    plan = replace(choose(*seen(0.0)), objective="trajectory", network="potential")
    run = fit(pendulum(), QUICK, plan=plan, progress=False)
    assert run.metrics["objective"] == "trajectory"
    assert run.metrics["plan"]["objective"] == "trajectory"


def test_a_wrong_plan_is_refused_in_words():
    # fails if a plan of another version ends in a TypeError
    plan = choose(*seen(0.0)).to_dict()
    with pytest.raises(InputError, match="unknown setting colour for Plan"):
        Plan.from_dict({**plan, "colour": "red"})
    with pytest.raises(InputError, match="the settings of Plan: lacks continues_probe, delay, departures"):
        Plan.from_dict({"level": "linear"})
    with pytest.raises(InputError, match="the plan's start lacks stiffness, rate"):
        Plan.from_dict({**plan, "start": {"tilt": [0.0], "stiffness": []}})
    with pytest.raises(InputError, match="plan must be a Plan, or a run that followed one, got dict"):
        fit(pendulum(), QUICK, plan=plan)  # pyright: ignore[reportArgumentType]
    two = {**plan, "start": {**plan["start"], "stiffness": [1.0, 1.0]}}
    with pytest.raises(InputError, match="the plan has 2 coordinates, the data have 1"):
        fit(pendulum(), QUICK, plan=Plan.from_dict(two))


def test_what_is_no_config_is_refused():  # fails if hz.fit(t, q) ends in numpy's words on truth values
    t = np.arange(10.0)
    with pytest.raises(InputError, match="config must be a FitConfig, got ndarray; times go to time=: fit"):
        fit(t, t)  # pyright: ignore[reportArgumentType]


def test_the_plan_in_words():  # fails if a newcomer reads names of fields, or of decisions that have no effect
    plan = replace(choose(*seen(0.01)), network="none", sigma=0.0123, fitted_before=True, substeps=1)
    plan = replace(plan, absent=("friction.viscous[1]", "friction.input_map"))
    words = dict(taken.split(": ", 1) for decisions, _ in plan.by_reason("rad") for taken in decisions)
    assert words["fitted to"] == "whole trajectories (trajectory)"
    assert words["noise assumed"] == "0.0123 rad"
    assert words["masses and friction"] == "one mass, and a potential of the named terms alone"
    assert words["numbers that are 0"] == "viscous friction (2), the map from inputs to forces"
    idle = ("hold", "delay", "lag", "drag", "substeps", "restarts", "departures", "continues_probe")
    assert not {WORDS[name] for name in idle} & set(words)


def test_the_waves_of_a_function_are_one_entry_of_the_plan():
    # fails if a function fills the screen (160 waves), if waves of other coordinates or by speeds are counted with
    # them, or a few harmonics are counted in place of named
    waves = tuple(f"cos({k} q1 - 2.5 q2)" for k in range(1, 8))
    brakes = tuple(f"sin({k} q1) v1" for k in range(1, 9))
    few = ("q1^2", "cos(q1)", "sin(q1)")
    text = "q1^2, cos(q1), sin(q1), 7 waves of q1, q2, 8 waves of q1 by v1"
    assert plan_in_words("features", (*few, *waves, *brakes)) == text
