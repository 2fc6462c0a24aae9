"""Set-valued friction is taken where driven data show dry friction, and as set where the user says it."""

from functools import cache

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.training import FitConfig, choose, look
from herglotz.training.dry_friction import friction_holds
from herglotz.training.stages import Stages
from herglotz.training.task import with_sticking


@cache
def driven(name):
    return simulate(scene(name), trajectories=2, steps=60, h=0.05, seed=0)


@pytest.mark.parametrize(("name", "expected"), [("servo_axis", True), ("driven_pendulum", False)])
def test_dry_friction_is_seen_in_held_out_blocks(name, expected):
    # fails if a sign of the velocity that only fits its own rows counts, or one that does not brake
    found, why = friction_holds(driven(name))
    assert found is expected, why
    assert "standard errors" in why


def test_a_push_along_the_velocity_is_no_friction():
    # fails if any sign of the coefficient is taken for friction: the motion run backward
    data = driven("servo_axis")
    assert data.u is not None
    assert not friction_holds(Trajectories.of(data.t, data.q.flip(0), data.lengths, u=data.u.flip(0)))[0]


@pytest.mark.parametrize(
    ("settings", "expected"), [({}, True), ({"sticking": False}, False), ({"coulomb": True}, False)]
)
def test_the_plan_says_why(settings, expected):
    # fails if the user's word is overruled, or the reason of the plan is another decision's
    config = FitConfig(iterations=5, **settings)
    seen = look(driven("servo_axis"), config, Stages(False, None, "", resume=False))
    plan = choose(seen, config)
    assert plan.forces["sticking"] is expected
    assert (plan.objective == "trajectory" and "standard errors" in plan.reasons["forces"]) is expected
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
