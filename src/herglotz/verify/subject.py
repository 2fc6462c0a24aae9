"""What `verify` measures: of a scene, a run, a file, an L_d or a stepper the step map and sample states.

`subject` makes a `Subject` of any of these targets; the checks of the other modules see the `Subject` alone.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data.simulate import uniform
from herglotz.errors import InputError, did_you_mean
from herglotz.export import ExportedStepper, load_exported
from herglotz.export.compare import draw
from herglotz.export.differences import differenced, differentiable
from herglotz.mechanics import DiscreteLagrangian, momentum_minus, partials
from herglotz.mechanics.contact import Flow
from herglotz.models import ContactLagrangian, capabilities
from herglotz.scenes import Scene, scene, scene_names
from herglotz.stepping import OneStepMethod, Rollout, State, Step, Stepper
from herglotz.stepping.state import check_batch
from herglotz.theory import TimeDependent
from herglotz.training import Run, load_run

# Largest number of coordinates that is tried on a function.
MAX_COORDINATES = 12
# Samples where no number is given, and most numbers in the derivatives of their maps: 64 samples of up to 10
# coordinates, 6 of 32, which take a minute.
SAMPLES, MOST = 64, 64 * 21**2


def drawn_states(L_d: DiscreteLagrangian, h: float, samples: int, make: torch.Generator) -> State:
    """Return (q0, p0, s0) with q0 and q̇ standard normal, s0 in [−1, 1], and p0 = −D1 L_d(q0, q0 + h q̇, s0)/c.

    A learned model provides the sizes of q and q̇ and the number of coordinates. A function is tried with 1, 2, …
    coordinates until it accepts the number, so a sum over coordinates is verified for one. Raise InputError if the
    function accepts no number up to 12, or gives no finite momentum.
    """
    if isinstance(L_d, ContactLagrangian):
        scale, speed = (torch.tensor(x, dtype=torch.float64) for x in (L_d.config.scale, L_d.config.speed))
        dtype = next(L_d.parameters()).dtype
        return _drawn(L_d, scale.to(dtype), speed.to(dtype), h, samples, make)
    refused = ""
    for n in range(1, MAX_COORDINATES + 1):
        one = torch.ones(n, dtype=torch.float64)
        try:
            return _drawn(L_d, one, one, h, samples, make)
        except (IndexError, RuntimeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            refused = str(error).splitlines()[0]
    raise InputError(
        f"no states could be drawn: up to {MAX_COORDINATES} coordinates the function fails ({refused}); "
        "give (L_d, (q, p, s))"
    )


def _drawn(
    L_d: DiscreteLagrangian, scale: Tensor, speed: Tensor, h: float, samples: int, make: torch.Generator
) -> State:
    shape = (samples, len(scale))
    q, v = (torch.randn(shape, generator=make, dtype=torch.float64).to(scale) * size for size in (scale, speed))
    s = (2 * torch.rand(samples, generator=make, dtype=torch.float64) - 1).to(scale) * (scale * speed).sum()
    with torch.no_grad():
        P = partials(L_d, q, q + h * v, s, h)
    p = momentum_minus(P)
    good = torch.isfinite(P.L) & torch.isfinite(p).all(-1)
    if not bool(good.any()):
        raise InputError("L_d has no finite momentum at q, q̇ of size 1; give states: (L_d, (q, p, s))")
    return State(q[good], p[good], s[good])


# Bounds on identities whose derivatives are central differences of order 8 (`differenced`). A step has a
# rounding error of 10–100 eps and an offset is 0.01 (float32: 0.1) of 1 + |x|, so a derivative has a rounding error of
# 1e-13–1e-12 (float32: 1e-5). The truncation error, offset⁸ f⁽⁹⁾/630, is smaller where f is smooth over the offsets.
# Products of such derivatives over k steps and divisions by ∂q1/∂p0 ~ h multiply the error by 10–1000. Null models
# exceed 1e-3.
DIFFERENCED = {torch.float64: 1e-9, torch.float32: 2e-3}


@dataclass(frozen=True)
class Subject:
    """A step map, its sample states, and the L_d, scene or run behind the map if known.

    `kind` is "scene", "run", "stepper", "L_d" or the kind of a file: "pt2", "aoti", "onnx", "c". `metadata` is that of
    a file. `differenced` says that the file has no derivatives, so that those of the map are finite differences.
    """

    name: str
    kind: str
    step: Callable[[State, float], Step]
    states: State  # (B, n), (B, n), (B)
    h: float
    L_d: DiscreteLagrangian | None = None
    scene: Scene | None = None
    run: Run | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    differenced: bool = False

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return self.states.q.shape[-1]

    @property
    def forced(self) -> bool:
        """Whether the target is a file of the forced level, whose map is no contact map."""
        return self.metadata.get("level") == "forced"

    @property
    def sticks(self) -> bool:
        """Whether set-valued dry friction can hold a coordinate."""
        made_of = capabilities(self.L_d)
        return made_of.sticking if made_of is not None else bool(self.metadata.get("model", {}).get("sticking"))

    @property
    def derivative_of(self) -> str:
        """The source of the derivative that is judged, for the table."""
        return "the file's" if self.metadata and self.kind != "pt2" else "autograd"

    def at(self, k: int | Tensor) -> Subject:
        """Return the subject of step k, () or (...); each step has its own L_d if L_d depends on time."""
        if not isinstance(self.L_d, TimeDependent):
            return self
        t = self.L_d.t0 + self.h * torch.as_tensor(k).to(self.states.s)
        L_d = self.L_d.at(t[..., None])
        return replace(self, L_d=L_d, step=Stepper(L_d).step)

    def flow(self, k: int = 1, first: int = 0) -> Flow:
        """Return the map (q, p, s) → (q_k, p_k, s_k) of k steps from step `first` on; NaN where a step failed."""
        return lambda q, p, s: Map(self, first).rollout(q, p, s, h=self.h, steps=k).final

    def rollout(self, start: State, steps: int) -> Rollout:
        """Roll the map out from `start`."""
        return Map(self).rollout(*start, h=self.h, steps=steps)


class Map(OneStepMethod):
    """The steps of a subject from step `first` on as a stepper, for `OneStepMethod.rollout`."""

    def __init__(self, subject: Subject, first: int = 0):
        self.subject, self.next = subject, first

    def step(self, state: State, h: Any, guess: Tensor | None = None) -> Step:  # noqa: ARG002
        """The next step."""
        step = self.subject.at(self.next).step(state, self.subject.h)
        self.next += 1
        return step


def subject(target: Any, h: float | None, samples: int | None, seed: int) -> Subject:
    """Return the `Subject` of any target of `verify`, by default with 64 samples, and fewer beyond 10 coordinates."""
    if samples is not None or isinstance(target, tuple):
        return _subject(target, h, SAMPLES if samples is None else samples, seed)
    whole = _subject(target, h, SAMPLES, seed)
    kept = max(1, MOST // (2 * whole.dof + 1) ** 2)
    return replace(whole, states=State(*(x[:kept] for x in whole.states)))


def _subject(target: Any, h: float | None, samples: int, seed: int) -> Subject:
    """Return the `Subject` of any target of `verify`.

    States are drawn from the `q_range` and `v_range` of a scene with s in [−1, 1], from the fitted states of a run, or
    from the box of a file; for an L_d alone by `drawn_states`. A pair (L_d or stepper, states) brings its own states.
    Raise InputError if the target is none of these, or h is missing or not positive.
    """
    if samples < 1:
        raise InputError(f"samples must be >= 1, got {samples}")
    make = torch.Generator().manual_seed(seed)
    target = named(target)
    if isinstance(target, Scene):
        states, size, step = _scene_states(target, samples, make), _step_size(h, target.h), Stepper(target.L_d).step
        return Subject(f"scene {target.name}", "scene", step, states, size, target.L_d, target)
    if isinstance(target, Run):
        states, size, step = _run_states(target, samples, make), _step_size(h, target.h), Stepper(target.model).step
        return Subject(f"run on {target.data.source or 'data'}", "run", step, states, size, target.model, run=target)
    if isinstance(target, ExportedStepper):
        return _file(target, draw(target, samples, make), _step_size(h, target.h))
    if isinstance(target, tuple) and len(target) == 2:
        return _pair(*target, h)
    if hasattr(target, "step"):
        raise InputError("a stepper alone has no states; give a pair (stepper, (q, p, s)) and h")
    if callable(target):
        if h is None:
            raise InputError("h must be given with an L_d, e.g. h=0.1")
        L_d: Any = target
        return _pair(L_d, drawn_states(L_d, _step_size(h, h), samples, make), h)
    raise InputError(
        f"cannot verify a {type(target).__name__}; "
        "give a scene, a run, an exported file, an L_d or a pair (L_d or stepper, states)"
    )


def named(target: Any) -> Any:
    """Return the scene of a name, the run of a folder, the stepper of an exported file; any other target unchanged."""
    if not isinstance(target, str | os.PathLike):
        return target
    if target in scene_names():
        return scene(str(target))
    path = Path(target)
    if path.is_dir():
        return load_run(path)
    if path.suffix == ".pt2" or path.is_file():
        return load_exported(path)
    known = scene_names()
    near = did_you_mean(str(target), known)
    raise InputError(
        f"{target}: no such scene ({', '.join(known)}), run folder or .pt2, .onnx, .h, .c or .fmu file{near}"
    )


def _file(target: ExportedStepper, states: State, h: float) -> Subject:
    """Return the subject of a file; DΦ̃ comes from autograd, from the file or, without either, from differences."""
    whole = Subject(target.path, target.kind, target.step, states, h, metadata=target.metadata)
    if target.differentiable:
        return whole
    if "linearise" in target.programs:
        return replace(whole, step=differentiable(target, lambda state, h: target.linearise(state, h).by_state))
    return replace(whole, step=differenced(target, whole.sticks), differenced=True)


def _pair(source: Any, states: Any, h: float | None) -> Subject:
    """Return the subject of given states (q, p, s) and an L_d, or an object with `step(state, h) -> Step`."""
    if h is None:
        raise InputError("h must be given with a pair (L_d or stepper, states), e.g. h=0.1")
    state, size = State(*(x.detach() for x in check_batch(states))), _step_size(h, h)
    if hasattr(source, "step"):
        return Subject(type(source).__name__, "stepper", source.step, state, size, getattr(source, "L_d", None))
    return Subject(getattr(source, "__name__", type(source).__name__), "L_d", Stepper(source).step, state, size, source)


def _step_size(h: float | None, default: float) -> float:
    size = float(default if h is None else h)
    if not 0 < size < float("inf"):
        raise InputError(f"h must be finite and > 0, got {size:g}")
    return size


def _scene_states(scene: Scene, samples: int, make: torch.Generator) -> State:
    """Draw states uniformly in the ranges of a scene."""
    q, v = (uniform(name, getattr(scene, name), (samples, scene.dof), make) for name in ("q_range", "v_range"))
    s = torch.empty(samples, dtype=torch.float64).uniform_(-1.0, 1.0, generator=make)
    return State(q, scene.momentum(q, v, s), s)


def _run_states(run: Run, samples: int, make: torch.Generator) -> State:
    """Draw finite fitted states of a run without repetition."""
    dtype = next(run.model.parameters()).dtype
    states = State(*(x.detach().to(dtype) for x in run.states))
    finite = states.finite.nonzero()[:, 0]
    if not len(finite):
        raise InputError("the run holds no finite state; its fit has diverged, fit again")
    index = finite[torch.randperm(len(finite), generator=make)[:samples]]
    return State(*(x[index] for x in states))
