"""The eight scenes of the trade: how long, from which starts, against which truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from herglotz.scenes import scene
from herglotz.stepping import State

CHECKS = 4  # times at which errors are taken
# What a user knows of two links.
TOLD = {"features": ("pendulums",), "order": 4, "correction_width": 0, "mass_width": 0}


@dataclass(frozen=True)
class Setup:
    """What one scene is asked: data every h, motions of length T, and the model that is fitted."""

    name: str
    h: float
    T: float
    fit: Mapping[str, Any] = field(default_factory=dict)
    trajectories: int = 30
    steps: int = 30
    multiples: tuple[int, ...] = (2, 4)  # steps of distilled models, in h
    kick_steps: tuple[int, ...] = ()  # in h
    neural: tuple[tuple[int, int], ...] = ((8, 1),)  # width and depth of the neural ODEs
    neural_iterations: int = 60
    rules: tuple[int, ...] = (1, 2, 4)  # steps of analytic rules in one h

    # What a term of the model brings, or costs where it is not needed: the same data without it, or with it.
    other: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def scene(self) -> Any:
        """The scene itself."""
        return scene(self.name)

    @property
    def held(self) -> int | None:
        """Number of steps h over which an input is held one after the other; None without inputs."""
        return round(self.T / self.h) if self.scene.drive is not None else None

    def inputs(self) -> Tensor | None:
        """(T/h, m) the input of each step of the data."""
        if self.scene.drive is None:
            return None
        return self.scene.drive(self.h * (torch.arange(round(self.T / self.h), dtype=torch.float64) + 0.5))


SETUPS = {
    s.name: s
    for s in (
        Setup(
            "damped_oscillator",
            0.5,
            12.0,
            {"potential_width": 0, "correction_width": 8},
            kick_steps=(2, 6),
            other={
                "level conservative": {"level": "conservative"},
                "level affine": {"level": "affine"},
                "potential network": {"potential_width": 16},
                "no correction": {"correction_width": 0},
            },
        ),
        Setup(
            "damped_pendulum",
            0.5,
            12.0,
            {"correction_width": 16, "iterations": 300},
            40,
            40,
            (2, 3),
            (2, 3, 6),
            rules=(1, 2, 4, 8),
            neural=((4, 1), (8, 1), (8, 2), (16, 2)),
            neural_iterations=200,
            other={
                "level conservative": {"level": "conservative"},
                "level affine": {"level": "affine"},
                "no correction": {"correction_width": 0},
            },
        ),
        Setup(
            "double_pendulum",
            0.05,
            2.4,
            {"correction_width": 16, "mass_width": 8, "iterations": 120},
            multiples=(2, 3),
            neural=((8, 1), (16, 2)),
            neural_iterations=120,
            other={
                "level conservative": {"level": "conservative"},
                "constant mass": {"mass_width": 0},
                "no correction": {"correction_width": 0},
                "structure told": TOLD,
            },
        ),
        Setup(
            "parachute",
            0.1,
            2.4,
            {"level": "affine"},
            other={
                "level conservative": {"level": "conservative"},
                "level linear": {"level": "linear"},
                "no correction": {"correction_width": 0},
            },
        ),
        Setup(
            "kepler",
            0.1,
            4.8,
            {"features": ("central",), "alike": True, "correction_width": 16},
            other={
                "level conservative": {"level": "conservative"},
                "potential network": {"features": (), "alike": False},
                "no correction": {"correction_width": 0},
            },
        ),
        Setup(
            "chain",
            0.2,
            4.8,
            {"features": ("chain",), "alike": True, "correction_width": 0},
            12,
            20,
            (2,),
            neural_iterations=30,
            other={
                "level conservative": {"level": "conservative"},
                "linear springs": {"features": (), "alike": False, "potential_width": 0},
            },
        ),
        Setup(
            "driven_pendulum",
            0.25,
            12.0,
            {"level": "forced", "correction_width": 12},
            other={
                "no input": {"use_inputs": False},
                "no correction": {"correction_width": 0},
                "correction 6 × 2": {"correction_width": 6},
            },
        ),
        Setup(
            "rigid_body",
            0.1,
            4.8,
            {"correction_width": 12, "mass_width": 8},
            20,
            24,
            neural=((12, 1),),
            other={
                "constant mass": {"mass_width": 0},
                "level conservative": {"level": "conservative"},
                "no correction": {"correction_width": 0},
            },
        ),
    )
}


def starts_of(system: Any, count: int, seed: int) -> State:
    """States uniform in the scene's ranges, s = 0."""
    generator = torch.Generator().manual_seed(seed)
    spans = []
    for low, high in (system.q_range, system.v_range):
        low, high = (torch.as_tensor(x, dtype=torch.float64).expand(count, system.dof) for x in (low, high))
        spans.append(low + (high - low) * torch.rand(count, system.dof, generator=generator, dtype=torch.float64))
    q, v = spans
    return State(q, system.momentum(q, v, torch.zeros_like(q[..., 0])), torch.zeros(count, dtype=torch.float64))


def exact_motion(setup: Setup, start: State) -> Tensor:
    """Positions (B, checks, n) at equal times up to T, by the scene's own flow in steps h."""
    system, u, state, out = setup.scene, setup.inputs(), start, []
    steps = round(setup.T / setup.h)
    for k in range(steps):
        now = system if u is None else system.at(u[k])
        state = State(*now.flow(*state, setup.h))
        if (k + 1) % (steps // CHECKS) == 0:
            out.append(state.q)
    return torch.stack(out, 1)


def errors_of(q: Tensor, truth: Tensor) -> dict[str, float | None]:
    """Of the largest |q − truth| of each motion: the median, and what 95 % keep; None where a step failed."""
    e = (q.double() - truth).abs().flatten(1).amax(1).nan_to_num(nan=math.inf)
    found = {"median": float(e.median()), "q95": float(e.quantile(0.95, interpolation="higher"))}
    return {k: v if math.isfinite(v) else None for k, v in found.items()}


def judged(q: Tensor, truth: Tensor) -> dict[str, float | None]:
    """Errors of the second half of the motions, and, to choose a setting by, of the first."""
    half = len(q) // 2
    choice = {f"choice_{k}": v for k, v in errors_of(q[:half], truth[:half]).items()}
    return {**errors_of(q[half:], truth[half:]), **choice}
