"""Exported files of any format as steppers with the interface of `herglotz.stepping.Stepper`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.export.parameters import checked_values
from herglotz.export.step import Box, s_matters
from herglotz.stepping import Linearised, OneStepMethod, State, Step, step_sizes
from herglotz.stepping.events import Watch
from herglotz.stepping.rollout import Plan, Track, without_lost_factors
from herglotz.stepping.state import (
    action_of,
    check_h,
    check_moving,
    check_rows,
    check_started,
    check_state,
    parts_of,
)
from herglotz.stepping.velocity import Legendre, momentum, velocity

Program = Callable[..., tuple[Tensor, ...]]
# (q (B, n), p (B, n), s (B,), h (B, K)[, u (B, K, m)]) → K steps, in any memory layout
Loop = Callable[..., Track]
FILES = {"pt2": "a .pt2", "aoti": "an AOTInductor", "onnx": "an ONNX", "c": "a C"}


class ExportedStepper(OneStepMethod):
    """The flow Φ̃ of an exported model, with the results of `Stepper`; `load_exported` reads a file.

    Parameters
    ----------
    programs
        Functions of contiguous tensors: `rollout` (q, p, s, h (K, B)[, u]) → K steps, and where the format has them
        `model`, one differentiable step, `linearise`, `init`, and `legendre` (or `momentum` and `velocity`).
    metadata
        The file's own: model, dof, dtype, h, units, angles, box, versions, weights_sha256.
    path
        Where the file was read from, for messages.
    kind
        "pt2", "aoti", "onnx", "c", or the name of another format.
    loop
        The loop of K steps of a format without the program `rollout`; it needs no inputs where none act.
    again
        Makes the stepper of other values of the numbers that are set at run time.
    """

    def __init__(
        self,
        programs: Mapping[str, Program],
        metadata: dict[str, Any],
        path: str = "exported model",
        kind: str = "pt2",
        loop: Loop | None = None,
        again: Callable[[Mapping[str, float]], ExportedStepper] | None = None,
    ):
        self._again = again
        self.programs = dict(programs)
        self.metadata = metadata
        self.path = path
        self.kind = kind
        self.dof: int = metadata["dof"]
        self.inputs: int = metadata.get("inputs", 0)
        self.dtype: torch.dtype = getattr(torch, metadata["dtype"])
        self.h: float = metadata["h"]
        # An example of the dtype, for a step given as a Python number.
        self._like = torch.empty((), dtype=self.dtype)
        self.loop = scanned(self.programs["rollout"]) if loop is None else loop
        # The inputs at which no force acts, for programs that need inputs.
        self._idle: Tensor | None = None
        if loop is None and self.inputs:
            self._idle = torch.tensor(metadata.get("input_zero") or [0.0] * self.inputs, dtype=self.dtype)
        box = metadata["box"]
        angles = metadata.get("angles", [False] * self.dof)
        self._box = None if box is None else Box(box, angles, self.dtype, by_s=s_matters(metadata))

    def __repr__(self) -> str:
        return f"ExportedStepper({self.path}: {self.kind}, dof {self.dof}, {self.metadata['dtype']}, h {self.h:g})"

    @property
    def differentiable(self) -> bool:
        """Whether autograd goes through `step`."""
        return "model" in self.programs

    @property
    def parameters(self) -> dict[str, float]:
        """The default values of the numbers that are set at run time, by name."""
        return {name: value for name, (value, *_) in self.metadata.get("parameters", {}).items()}

    def with_parameters(self, values: Mapping[str, float]) -> ExportedStepper:
        """The stepper with these values of numbers that are set at run time; numbers not named have their defaults.

        `parameters` has the names; values are in the model's own units. Raise InputError if the file has no such
        number, or a value is not finite or outside its bounds.
        """
        checked_values(self.metadata.get("parameters", {}), values)
        return self if self._again is None else self._again(values)

    def init(
        self, q0: Tensor, q1: Tensor, s0: Tensor | None = None, h: Tensor | float = 1.0, u: Tensor | None = None
    ) -> State:
        """The state (q1, p1, s1) = FL⁺(q0, q1, s0) from two positions h apart; s0 defaults to 0.

        Raise InputError as in `step`, and where the file has no such program.
        """
        if "init" not in self.programs:
            raise InputError(f"{self.path}: {self._file} file starts from (q, p, s) only; use a .pt2 file for init")
        s0 = action_of(s0, q0=q0, q1=q1)
        self._check(q0, q1, s0, ("q0", "q1", "s0"), finite=True)
        p, s = self.programs["init"](*map(plain, self._flat(State(q0, q1, s0), h, u)))
        return check_started(State(q1, p.reshape(q1.shape), s.reshape(s0.shape)))

    def init_qv(self, q: Tensor, v: Tensor, s: Tensor | None = None, h: Tensor | float = 1.0) -> State:
        """The state (q, p, s) of a position and a velocity, as in `Stepper.init_qv`.

        Raise InputError as in `step`, and where the file has no velocities.
        """
        s = action_of(s, q=q, v=v)
        self._check(q, v, s, ("q", "v", "s"), finite=True)
        flat = [plain(x) for x in self._flat(State(q, v, s), h, None)[:4]]
        transform: Any = self.programs.get("momentum", partial(momentum, self._legendre))
        p = transform(*flat)
        return check_started(State(q, p.reshape(q.shape), s))

    def velocity(self, state: State, h: Tensor | float = 1.0) -> Tensor:
        """The velocity v (..., n) of states, as in `Stepper.velocity`, without derivatives.

        Raise InputError as in `step`, and where the file has no velocities; StepError where a state has no velocity.
        """
        self._check(*parts_of(state), finite=True)
        with torch.no_grad():
            q, p, s, h = (plain(x) for x in self._flat(state, h, None)[:4])
            if "velocity" in self.programs:
                v, status = self.programs["velocity"](q, p, s, h)
            else:
                v, status = velocity(self._legendre, State(q, p, s), h)
        return check_moving(v.reshape(state.q.shape), status.reshape(state.s.shape))

    def _legendre(self, *x: Tensor) -> Legendre:
        if "legendre" not in self.programs:
            raise InputError(f"{self.path}: {self._file} file without velocities; export the model again, as .pt2 or C")
        return Legendre(*self.programs["legendre"](*map(plain, x)))

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None, u: Tensor | None = None) -> Step:
        """One step, as in `Stepper.step`, in the dtype of the file, which makes its own guess; u None: no input acts.

        NaN in the samples whose status is not `Status.CONVERGED`; `iterations` is the bound, not a count. Raise
        InputError if the file does not take this shape, dtype, h or u; a state that is not finite has a status instead.
        """
        del guess
        self._check(*parts_of(state))
        flat = self._flat(state, h, u)
        if self.differentiable:
            return self._step(self.programs["model"](*map(plain, flat)), state)
        track = self._with_box(self.loop(*flat[:3], *(x[:, None] for x in flat[3:])))
        outside = () if track.outside is None else (track.outside[:, 0],)
        new = (x[:, 1] for x in (*track.states, track.sigma))
        return self._step((*new, track.residual[:, 0], track.status[:, 0], *outside), state)

    def linearise(self, state: State, h: Tensor | float, u: Tensor | None = None) -> Linearised:
        """One step and its derivative with respect to the state, h and u, by the implicit-function theorem.

        The step, d(q, p, s)′/d(q, p, s) (..., 2n+1, 2n+1), /dh (..., 2n+1) and, for a model with inputs, /du; NaN where
        the step failed. The result has no derivatives by autograd. Raise InputError as in `step`, and where the format
        has no derivative.
        """
        if "linearise" not in self.programs:
            many = f" of {self.dof} coordinates" if self.kind == "c" else ""
            message = f"{self._file} file{many} holds no derivative; use a .pt2 or ONNX file, or Stepper.linearise"
            raise InputError(f"{self.path}: {message}")
        with torch.no_grad():
            self._check(*parts_of(state))
            state = State(*(x.detach() for x in state))
            *out, J = self.programs["linearise"](*map(plain, self._flat(state, h, u)))
        J, size = J.reshape(*state.s.shape, *J.shape[1:]), 2 * self.dof + 1
        by_input = J[..., size + 1 : size + 1 + self.inputs] if self.inputs else None
        by_theta = J[..., size + 1 + self.inputs :] if self.parameters else None
        return Linearised(self._step(out, state), J[..., :size], J[..., size], by_input, by_theta)

    def outside_box(self, state: State) -> Tensor:
        """(...) True where a state lies outside the box that the model was fitted in; angles count modulo 2π.

        Raise InputError if the file records no box, or the state has another shape or dtype than the file.
        """
        if self._box is None:
            raise InputError(f"{self.path}: records no box; export it again with box=")
        check_state(state, self)
        return self._box(*state)

    def _roll_out(
        self,
        start: State,
        h: Tensor | float,
        steps: int | None,
        inputs: Tensor | None = None,
        watch: Watch | None = None,
        **plan: Any,
    ) -> Track:
        """K steps in the file's own loop, without derivatives."""
        if watch is not None:
            raise InputError(f"{self._file} file has no events; use herglotz.Stepper")
        every, batch = plan["every"], start.s.shape
        h_all = step_sizes(self._checked_h(h), steps)
        steps = h_all.shape[-1]
        Plan(steps, every)
        h_all = spread_h(h_all, (*batch, steps))
        flat = (x.reshape(-1, *x.shape[len(batch) :]) for x in (*start, h_all, *self._inputs(inputs, (*batch, steps))))
        with torch.no_grad():
            track = self._with_box(without_lost_factors(self.loop(*flat)))
        return _decimated(track, every, batch)

    def _with_box(self, track: Track) -> Track:
        """The track with a flag of every step that starts or ends outside the box, where the loop has set no flags."""
        if self._box is None or track.outside is not None:
            return track
        there = self._box(*track.states)
        return track._replace(outside=(there[..., 1:] | there[..., :-1]).to(torch.uint8))

    def _step(self, out: Sequence[Tensor], state: State) -> Step:
        """The outputs of a program as a step with the shape of `state`."""
        q, _, s = state
        q1, p1, s1, c, residual, status, *outside = out
        new = State(q1.reshape(q.shape), p1.reshape(q.shape), s1.reshape(s.shape))
        c, residual, status, *outside = (x.reshape(s.shape) for x in (c, residual, status, *outside))
        return Step(new, c, status, residual, self.metadata["newton_iterations"], *outside)

    @property
    def _file(self) -> str:
        return FILES.get(self.kind, f"a {self.kind}")

    def _checked(self, state: State) -> State:
        self._check(*state)
        return state

    def _checked_inputs(self, inputs: Tensor, like: Tensor) -> Tensor:
        # Not converted to the dtype of the states: `check_inputs` refuses another dtype.
        del like
        check_rows(inputs)
        return inputs

    def _check(
        self, q: Tensor, p: Tensor, s: Tensor, names: tuple[str, str, str] = ("q", "p", "s"), finite: bool = False
    ) -> None:
        check_state(State(q, p, s), self, names, finite=finite)
        if s.numel() == 0:
            raise InputError(f"{', '.join(names)} hold no samples; give at least one")
        for name, x in zip(names, (q, p, s), strict=True):
            if x.device.type != "cpu":
                raise InputError(f"{name} must be on the CPU, got {x.device}; use {name}.cpu()")
            if x.requires_grad and not self.differentiable and torch.is_grad_enabled():
                message = f"{self._file} file has no derivatives: it takes {name} without gradient"
                raise InputError(f"{message}; use a .pt2 file, or {name}.detach()")

    def _checked_h(self, h: Tensor | float) -> Tensor:
        h = check_h(h, self._like)
        check_range(h, self.metadata.get("h_range"))
        return h

    def _flat(self, state: State, h: Tensor | float, u: Tensor | None) -> tuple[Tensor, ...]:
        """(B, n), (B, n), (B,), (B,)[, (B, m)]."""
        q, p, s = state
        h = spread_h(self._checked_h(h), s.shape)
        more = (x.reshape(s.numel(), -1) for x in self._inputs(u, s.shape))
        return q.reshape(-1, self.dof), p.reshape(-1, self.dof), s.reshape(-1), h.reshape(-1), *more

    def _inputs(self, u: Tensor | None, shape: tuple[int, ...]) -> tuple[Tensor, ...]:
        """(u,) of shape (*shape, m); for None the inputs at which no force acts, or () where the loop needs none."""
        if u is None:
            return () if self._idle is None else (self._idle.expand(*shape, self.inputs),)
        if u.ndim and u.ndim <= len(shape) + 1:
            # A shape that does not expand is refused below, with a message.
            with suppress(RuntimeError):
                u = u.expand(*shape, u.shape[-1])
        check_inputs(u, self.inputs, shape, self.dtype)
        return (u,)


def check_range(h: Tensor, span: Sequence[float] | None) -> None:
    """Refuse a step outside the range that the file records, if it records one."""
    if span is None:
        return
    slack = 4 * torch.finfo(h.dtype).eps
    if float(h.min()) < span[0] * (1 - slack) or float(h.max()) > span[1] * (1 + slack):
        found = " … ".join(dict.fromkeys(f"{float(x):g}" for x in (h.min(), h.max())))
        raise InputError(
            f"h must lie in [{span[0]:g}, {span[1]:g}], where the model was fitted; got {found}. "
            "Export it with another --h-range (h_range in Python) to step elsewhere"
        )


def spread_h(h: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The step h of every sample of a batch of this shape.

    Raise InputError if h is neither a scalar nor has this shape.
    """
    if h.ndim > len(shape) or not all(a in (1, b) for a, b in zip(h.shape[::-1], shape[::-1], strict=False)):
        raise InputError(f"h must be a scalar or match the batch {tuple(shape)}, got shape {tuple(h.shape)}")
    return h.expand(shape)


def check_inputs(u: Tensor, count: int, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """Refuse inputs u that the model does not take: shape (*shape, m), of the file's dtype."""
    if count == 0:
        raise InputError("the model takes no inputs; leave u out")
    if u.shape != (*shape, count) or u.dtype != dtype:
        raise InputError(f"u needs {count} number(s) a step in {dtype}, got {tuple(u.shape)} in {u.dtype}")


def scanned(program: Program) -> Loop:
    """A program of K steps (q, p, s, h (K, B)[, u (K, B, m)]) → (K, B, ...) as a loop."""

    def loop(q: Tensor, p: Tensor, s: Tensor, *rows: Tensor) -> Track:
        out = program(*map(plain, (q, p, s, *(x.transpose(0, 1) for x in rows))))
        *new, c, residual, status = (x.movedim(0, 1) for x in out[:6])
        states = tuple(torch.cat([x[:, None], y], 1) for x, y in zip((q, p, s), new, strict=True))
        sigma = torch.cat([torch.ones_like(s)[:, None], c], 1).cumprod(1)
        return Track(states, sigma, status, residual, outside=out[6].T if len(out) > 6 else None)

    return loop


def plain(x: Tensor) -> Tensor:
    """A copy in standard layout: compiled code ignores strides."""
    return x.contiguous() if x.requires_grad else x.clone(memory_format=torch.contiguous_format)


def _decimated(track: Track, every: int, batch: tuple[int, ...]) -> Track:
    """Each `every`-th state, with the worst status, residual and flag of the steps since the state before."""

    def kept(x: Tensor) -> Tensor:
        return x[:, ::every].reshape(*batch, -1, *x.shape[2:])

    def worst(x: Tensor) -> Tensor:
        return (x if every == 1 else x.unflatten(1, (-1, every)).amax(2)).reshape(*batch, -1)

    outside = None if track.outside is None else worst(track.outside)
    states = tuple(map(kept, track.states))
    return Track(states, kept(track.sigma), worst(track.status), worst(track.residual), (), outside)
