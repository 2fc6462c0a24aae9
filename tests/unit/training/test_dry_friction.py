"""Set-valued friction is taken where a search finds dry friction, and as set where the user says it."""

import math
from functools import cache

import pytest
import torch

from herglotz import fit
from herglotz.data import simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.training import FitConfig, choose, look
from herglotz.training.stages import Stages
from herglotz.training.task import with_sticking


@cache
def driven(name):
    return simulate(scene(name), trajectories=2, steps=60, h=0.05, seed=0)


# What a search does with `sticking=False` is shown by test_search.py, in no time.
@pytest.mark.parametrize(("settings", "expected"), [({}, True), ({"coulomb": True}, False)])
def test_the_plan_says_why(settings, expected):
    # fails if friction that holds is not asked for where nothing is said, or the user's word is overruled
    config = FitConfig(iterations=5, **settings)
    seen = look(driven("servo_axis"), config, Stages(False, None, "", resume=False))
    plan = choose(seen, config)
    assert plan.forces["sticking"] is expected
    assert plan.objective == "trajectory"
    assert "coulomb" in settings or "dry friction" in plan.reasons["forces"]
    assert plan.hold == "zero"
    assert plan.reasons["hold"] == "the data or the settings say so"
    assert torch.isfinite(torch.tensor(plan.start["stiffness"])).all()


def test_an_excess_that_is_off_stays_off():
    # fails if a fit that goes on from friction without Stribeck's excess starts it again
    model = ContactLagrangian(ModelConfig(level="forced", coulomb=True, potential_width=0))
    for excess in (True, False):
        friction = with_sticking(model, excess=excess).friction
        assert friction is not None
        assert bool(friction.breakaway.detach() > 0) is excess


def test_a_counting_encoder_that_starts_at_rest_does_not_hold_the_start():
    # fails if whole trajectories start from two equal readings: the first step then stands still whatever the momentum,
    # and friction of 0.66 for 0.5 made up for it, where the search had found 0.5 and the noise
    x, v, h, read = 1.4, 0.0, 0.0005, []
    for k in range(1200 * 10):
        if k % 10 == 0:
            read.append(x)
        v += h * (-40 * math.sin(x) - 0.3 * v - 0.5 * math.tanh(v / 1e-3))
        x += h * v
    count = 2 * math.pi / 512
    q = (torch.tensor(read, dtype=torch.float64) / count).round() * count
    assert float(q[0]) == float(q[1])
    run = fit(q, h=0.005, angles=True, progress=False)
    assert run.model.config.sticking
    assert run.metrics["verdict"].startswith("fits to the noise")
    assert run.metrics["train_rms"] < 1.1 * count / math.sqrt(12)
