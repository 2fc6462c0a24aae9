"""Named terms or networks: both are fitted to the first part of the training data, and run free over the rest of it.

Free runs on held-out time decide what no residual can. It costs one fit of each: named terms start from the values that
their search found on all training data, and are alone where they meet the held-out time at the noise already; networks,
the richer model, have to err less by a twentieth, and keep what they learn: the last fit goes on from there. They are
tried on as few samples as tell the motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from herglotz.data import Trajectories
from herglotz.data.oversampling import sparsest
from herglotz.data.roughness import precision
from herglotz.training.choose import choose
from herglotz.training.config import FitConfig
from herglotz.training.cross_validation import MARGIN
from herglotz.training.evaluate import free_run_rms
from herglotz.training.look import Look, look
from herglotz.training.objectives import OBJECTIVES
from herglotz.training.plan import Plan
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.verdict import AT_THE_NOISE

INNER = 0.75  # of the training part that rivals are fitted to


def held_out_winner(data: Trajectories, config: FitConfig, stages: Stages, seen: Look) -> tuple[Look, Plan]:
    """The plan whose free run over the last quarter of the training part errs less, with its look at the data."""
    named = choose(seen, config)
    first = stages.keep("held out, named terms", lambda: _held_out(seen, config, named))
    if first["rms"] <= AT_THE_NOISE * precision(seen.kept):
        return seen, _reasoned(
            named, f"free runs over held-out time miss {first['rms']:.2g} with named terms: the noise"
        )
    other = look(data, config, stages, named=False)
    networks = choose(other, config)
    every = sparsest(seen.kept)
    second = stages.keep("held out, networks", lambda: _held_out(seen, config, networks, every))
    why = f"free runs over the last quarter of the training part miss {first['rms']:.2g} with named terms, "
    why += f"{second['rms']:.2g} with networks ({networks.objective})"
    if first["rms"] <= MARGIN * second["rms"]:
        return seen, _reasoned(named, why)
    if networks.objective == "trajectory" and "departure" in second:
        start = {name: tuple(values) for name, values in second["start"].items()}
        networks = replace(
            networks, start={**networks.start, **start}, sigma=second["sigma"], departures=(second["departure"],),
            fitted_before=True,
            reasons={**networks.reasons, "fitted_before": "to three quarters of the training part"},
        )  # fmt: skip
    return other, _reasoned(networks, why)


def _reasoned(plan: Plan, why: str) -> Plan:
    return replace(plan, reasons={**plan.reasons, "objective": why, "network": why})


def _held_out(seen: Look, config: FitConfig, plan: Plan, every: int = 1) -> dict[str, Any]:
    """Error of the free run over the rest of the training part, and the fit to its first part, in plain values."""
    inner, silent = replace(config, train_fraction=INNER), Stages(False, None, "", resume=False)
    inside = look(seen.train.thinned(every), inner, silent, plan)
    task = Task(inside.kept, inside.base, inside.settings, silent, hurried=True)
    fitted = OBJECTIVES[plan.objective](task, inside, plan)
    found: dict[str, Any] = {"rms": free_run_rms(task, inside, fitted), "sigma": fitted.sigma}
    if fitted.notes.get("departure") is not None:
        values = {name: tuple(x.detach().reshape(-1).tolist()) for name, x in fitted.model.named_parameters()}
        found |= {"departure": fitted.notes["departure"], "start": values}
    return found
