"""Set-valued friction is taken where driven data show dry friction, and as set where the user says it."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.training import FitConfig, choose, look
from herglotz.training.dictionary_search import DictionarySearch
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


@pytest.mark.parametrize(
    ("plain", "excess", "kept"),
    [(1.01, 1.005, "plain"), (1.5, 1.0, "smooth"), (1.01, 0.8, "excess"), (0.9, None, "plain"), (None, 0.5, "smooth")],
)
def test_friction_that_holds_is_kept_where_smooth_friction_is_not_worth_its_widths(plain, excess, kept):
    # fails if smooth friction, or Stribeck's excess, stays for what its numbers take of the noise
    search: Any = object.__new__(DictionarySearch)
    search.data, search.floor, search.noise = SimpleNamespace(q=torch.zeros(100, 1), dof=1), 0.0, 0.0
    search.config, search._longer = SimpleNamespace(sticking=None), lambda found: found
    search._finer = lambda found, **_: found

    def make(rms, values):
        found: Any = SimpleNamespace(rms=rms, values=values, terms=SimpleNamespace(dry=True), pushes=False)
        found.config = SimpleNamespace(sticking=False)
        return found if rms else None

    found = make(1.0, {"friction.coulomb": (1.0,)})
    search._sticking = lambda _, start: make(excess if start else plain, {"friction.coulomb": (1.0,), "at": start})
    held = search._held(found)
    assert {None: "smooth", 0.0: "plain"}.get(held.values.get("at"), "excess") == kept


def test_an_excess_that_is_off_stays_off():
    # fails if a fit that goes on from friction without Stribeck's excess starts it again
    model = ContactLagrangian(ModelConfig(level="forced", coulomb=True, potential_width=0))
    for excess in (True, False):
        friction = with_sticking(model, excess=excess).friction
        assert friction is not None
        assert bool(friction.breakaway.detach() > 0) is excess
