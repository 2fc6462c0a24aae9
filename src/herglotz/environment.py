"""`VectorEnv`: a learned model as a batch of environments behind gymnasium's interface. Extra: `herglotz[gymnasium]`.

>>> import herglotz as hz
>>> env = hz.VectorEnv(run, 4096, reward=reward, reset=reset, max_episode_steps=200)
>>> observations, infos = env.reset(seed=0)
>>> observations, rewards, terminated, truncated, infos = env.step(actions)
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from herglotz.data.files import PathLike
from herglotz.data.input_terms import input_terms_of
from herglotz.errors import InputError, check_whole, refuse
from herglotz.export import ExportedStepper, export_run, load_c
from herglotz.export.exported import check_range
from herglotz.export.load import CLibrary
from herglotz.stepping import Status
from herglotz.stepping.state import check_h
from herglotz.training import Run

try:
    import gymnasium
    from gymnasium.vector.utils import batch_space
except ImportError:
    raise ImportError("VectorEnv needs gymnasium; install it: pip install 'herglotz[gymnasium]'") from None

Array = np.ndarray
Mode = gymnasium.vector.AutoresetMode
# Bits of `Status` in a status of C (docs/c.md). The next bit marks a state outside the box.
STATUS_BITS = 15


class VectorEnv(gymnasium.vector.VectorEnv):
    """B copies of a learned system, (q, p, s) ↦ (q, p, s)′ under an input u that is held, stepped together in C.

    An observation is (q, v), 2n numbers in the units of the data, per unit of time for v; an angle lies within half a
    turn of the middle of its recorded range. An action is u, m numbers in the units of the data; an action beyond the
    bounds saturates, as an actuator does. A reset computes p = ∂L/∂v from v, and each step computes v from p
    (`docs/c.md`).

    An environment ends (`terminated`) if a step fails, or if a state leaves the box of the data that the model was
    fitted to: beyond the box the model extrapolates. `infos["status"]`, (B,), is then the `Status` of the step, plus 16
    if the state left the box, and `infos["_status"]`, (B,) bool, marks the environments that ended in this way. No
    observation is NaN: a failed step returns the observation of the last good state, and a position outside the box is
    moved to its boundary.

    Parameters
    ----------
    source
        A run with inputs, the path of a C header that `run.export` or `export_c` wrote, or the result of `load_c`.
    num_envs
        Number of environments B.
    reward
        (q, v, u) ↦ (B,) rewards, of arrays (B, n), (B, n) and (B, m): the observation after the step, and the input
        during the step, after saturation.
    reset
        (generator, count) ↦ (q, v), each (count, n), or (q, v, s) with s (count,): starts of new episodes, inside the
        box. `env.reset(seed=…)` seeds the numpy generator. s is 0 by default.
    terminated
        (q, v, u) ↦ (B,) bool, which episodes the task ends; None: no episode.
    exit_reward
        Added to the reward, in the same unit, if a failed step or the box ends an episode. If rewards are costs, a
        policy gains by an early end unless `exit_reward` is negative.
    input_low, input_high
        (m,) bounds of u, in the units of the data; None: the recorded range.
    h
        Step, in the data's unit of time; None: the step of the model.
    steps_per_action
        Steps of h under one action.
    max_episode_steps
        Actions after which an episode is cut off (`truncated`); None: never.
    autoreset_mode
        "NextStep", "SameStep" or "Disabled", or gymnasium's `AutoresetMode`: which call resets an environment that
        ended. "NextStep": the next `step`, which ignores the action of this environment and returns the reward 0.
        "SameStep": the same `step`, with the last observation in `infos["final_obs"]`. "Disabled":
        `env.reset(options={"reset_mask": mask})`.
    dtype
        "float32" or "float64": dtype of observations and spaces. The model steps in the dtype of the header.
    trust_code
        As in `load_c`, for a header.

    Raises
    ------
    InputError
        If the source has no C, no inputs, no velocities or no recorded range of inputs, or an argument is wrong; from
        `reset` and `step`, if a user's function returns arrays of another shape or numbers that are not finite.
    ImportError
        If gymnasium is not installed.
    """

    def __init__(
        self,
        source: Run | ExportedStepper | PathLike,
        num_envs: int = 1,
        *,
        reward: Callable[[Array, Array, Array], Array],
        reset: Callable[[np.random.Generator, int], Sequence[Array]],
        terminated: Callable[[Array, Array, Array], Array] | None = None,
        exit_reward: float = 0.0,
        input_low: Sequence[float] | None = None,
        input_high: Sequence[float] | None = None,
        h: float | None = None,
        steps_per_action: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | gymnasium.vector.AutoresetMode = "NextStep",
        dtype: str = "float64",
        trust_code: bool = False,
    ):
        check_whole(1, num_envs=num_envs, steps_per_action=steps_per_action)
        if max_episode_steps is not None:
            check_whole(1, max_episode_steps=max_episode_steps)
        modes = [mode.value for mode in Mode]
        refuse({
            f"autoreset_mode must be one of {', '.join(modes)}, got {autoreset_mode!r}":
                autoreset_mode not in (*modes, *Mode),
            f"dtype must be 'float32' or 'float64', got {dtype!r}": dtype not in ("float32", "float64"),
            f"exit_reward must be a finite number, got {exit_reward!r}": not np.isfinite(exit_reward),
        })  # fmt: skip
        self.num_envs, self.mode, self.dtype = num_envs, Mode(autoreset_mode), np.dtype(dtype)
        self.metadata = {"autoreset_mode": self.mode, "render_modes": []}
        self.max_episode_steps, self.exit_reward = max_episode_steps, float(exit_reward)
        self._max_steps = np.iinfo(np.int64).max if max_episode_steps is None else max_episode_steps
        self._reward, self._draw, self._ends = reward, reset, terminated
        self.stepper = stepper = _stepper_of(source, trust_code)
        self._library = _library_of(stepper)
        model_dtype = self._model_dtype = np.dtype(stepper.metadata["dtype"])
        h_checked = check_h(stepper.h if h is None else h, torch.empty((), dtype=stepper.dtype)).reshape(1)
        check_range(h_checked, stepper.metadata.get("h_range"))
        self._h, self.h = h_checked, float(h_checked)
        self._low, self._high = low, high = [x.astype(model_dtype) for x in _positions(stepper)]
        n, unbounded = stepper.dof, np.full(stepper.dof, np.inf)
        box = lambda a, b: gymnasium.spaces.Box(a.astype(dtype), b.astype(dtype), dtype=self.dtype.type)  # noqa: E731
        self.single_observation_space = box(np.r_[low, -unbounded], np.r_[high, unbounded])
        self.single_action_space = inputs = box(*_input_bounds(stepper, input_low, input_high))
        self._input_low, self._input_high = inputs.low, inputs.high
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

        self._states, self._observed = (np.zeros((num_envs, k), model_dtype) for k in (2 * n + 2, 2 * n))
        self._u, self._status = np.zeros((num_envs, stepper.inputs), model_dtype), np.zeros(num_envs, np.int32)
        self._elapsed, self._ended = np.zeros(num_envs, np.int64), np.ones(num_envs, bool)
        self._started = self._some_ended = False
        self._step = self._call(self._states, self._u, steps_per_action, (self._observed, self._status))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start new episodes everywhere, or where `options={"reset_mask": mask}` says; return (B, 2n), {}."""
        super().reset(seed=seed)
        mask = np.ones(self.num_envs, bool)
        if options:
            refuse({f"options may hold reset_mask alone, got {', '.join(options)}": set(options) != {"reset_mask"}})
            mask = options["reset_mask"]
            fits = isinstance(mask, np.ndarray) and mask.shape == (self.num_envs,) and mask.dtype == bool
            refuse({
                f"reset_mask must be ({self.num_envs},) booleans, got {getattr(mask, 'dtype', type(mask).__name__)} of "
                f"shape {np.shape(mask)}": not fits,
                "reset_mask names no environment; set one entry": fits and not mask.any(),
                "the first reset must be of all environments; leave reset_mask out":
                    fits and not (self._started or mask.all()),
            })  # fmt: skip
        self._restart(mask)
        self._started = True
        return self._observed.astype(self.dtype), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Apply actions (B, m); return observations (B, 2n), rewards, terminated, truncated (B,), and infos."""
        if not self._started:
            raise InputError("call reset before the first step")
        ended_before = self._ended if self._some_ended else None
        if ended_before is not None and self.mode == Mode.DISABLED:
            which = f"environment {int(ended_before.argmax())} has ended"
            raise InputError(f'{which}; reset those that have: env.reset(options={{"reset_mask": ended}})')
        self._saturate(actions)
        self._step()
        self._elapsed += 1
        # Mode "NextStep": this call resets the environments that ended in the previous call.
        if ended_before is not None:
            self._restart(ended_before)
        observed, n = self._observed.copy(), self.stepper.dof
        q, v, u = (_read_only(x) for x in (observed[:, :n], observed[:, n:], self._u.copy()))
        rewards, lost = self._rewards(q, v, u), self._status != 0
        terminated = lost.copy()
        if self._ends is not None:
            terminated |= self._answer("terminated", self._ends(q, v, u), bool)
        truncated = self._elapsed >= self._max_steps
        if ended_before is not None:
            rewards[ended_before], terminated[ended_before] = 0.0, False
        infos: dict[str, Any] = {}
        if lost.any():
            rewards[lost] += self.exit_reward
            infos = {"status": self._status.copy(), "_status": lost}
        observations = observed.astype(self.dtype, copy=False)
        self._ended = terminated | truncated
        self._some_ended = bool(self._ended.any())
        if self._some_ended and self.mode == Mode.SAME_STEP:
            infos = self._finish(observations, infos)
            observations = self._observed.astype(self.dtype)
        return observations, rewards, terminated, truncated, infos

    def _finish(self, observations: Array, info: dict[str, Any]) -> dict[str, Any]:
        """Reset the environments that ended in this step; return their last observations in gymnasium's infos."""
        ended, last = self._ended, np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            last[i] = observations[i]
        self._restart(ended)
        return {"final_obs": last, "_final_obs": ended, "final_info": info, "_final_info": ended.copy()}

    def _call(self, states: Array, u: Array, steps: int, out: tuple[Array, Array]) -> Callable[[], None]:
        """Return the call of C that steps these arrays in place."""
        low, high, states_, u_, seen, status = map(torch.from_numpy, (self._low, self._high, states, u, *out))
        return self._library.holds(states_, self._h, u_, steps, low, high, (seen, status))

    def _saturate(self, actions: Array) -> None:
        """Write the saturated actions into the inputs of the next step."""
        actions = np.asarray(actions)
        if actions.shape != self._u.shape or actions.dtype.kind not in "fiu":
            given = f"{actions.dtype} of shape {actions.shape}"
            raise InputError(f"actions must be numbers of shape {self._u.shape}, got {given}")
        np.maximum(actions, self._input_low, out=self._u, casting="same_kind")
        np.minimum(self._u, self._input_high, out=self._u, casting="same_kind")
        if (wrong := np.isnan(self._u)).any():
            raise InputError(f"actions: NaN for environment {int(wrong.any(1).argmax())}; give finite numbers")

    def _restart(self, mask: Array) -> None:
        """Start new episodes in the environments of the mask."""
        count, n = int(mask.sum()), self.stepper.dof
        drawn = tuple(self._draw(self.np_random, count))
        refuse({f"reset must return (q, v) or (q, v, s), got {len(drawn)} entries": len(drawn) not in (2, 3)})
        parts = {"q": (count, n), "v": (count, n), "s": (count,)}
        q, v, s = arrays = [np.ascontiguousarray(x, self._model_dtype) for x in (*drawn, np.zeros(count))[:3]]
        for (name, shape), x in zip(parts.items(), arrays, strict=True):
            refuse({f"reset: {name} must have the shape {shape}, got {x.shape}": x.shape != shape})
            if not np.isfinite(x).all():
                row = int((~np.isfinite(x)).reshape(count, -1).any(1).argmax())
                raise InputError(f"reset: {name} of row {row} is NaN or inf; draw finite numbers")
        tensors = (torch.from_numpy(x) for x in (q, v, s))
        p = self._library.momentum(*tensors, h=self._h.expand(count).contiguous())
        states = np.concatenate([q, p.numpy(), s[:, None], np.ones((count, 1), self._model_dtype)], 1)
        observed, status = np.zeros((count, 2 * n), self._model_dtype), np.zeros(count, np.int32)
        self._call(states, np.zeros((count, self._u.shape[1]), self._model_dtype), 0, (observed, status))()
        if (wrong := status != 0).any():
            row = int(wrong.argmax())
            what = f"{Status(int(status[row]) & STATUS_BITS).name}: it has no momentum"
            if not status[row] & STATUS_BITS:
                box = {key: x for key, x in self.stepper.metadata["box"].items() if key[0] in "qps"}
                what = f"outside the box of the fitted data, {box}; its momentum is {p[row].tolist()}"
            raise InputError(f"reset: row {row}, q = {q[row].tolist()}, v = {v[row].tolist()}, is {what}")
        self._states[mask], self._observed[mask], self._status[mask], self._elapsed[mask] = states, observed, 0, 0
        self._ended = self._ended & ~mask
        self._some_ended = bool(self._ended.any())

    def _rewards(self, q: Array, v: Array, u: Array) -> Array:
        """Rewards of the user's function; raise if one is not finite."""
        rewards = self._answer("reward", self._reward(q, v, u), float)
        if not np.isfinite(rewards).all():
            row = int((~np.isfinite(rewards)).argmax())
            at = f"q = {q[row].tolist()}, v = {v[row].tolist()}, u = {u[row].tolist()}"
            raise InputError(f"reward: {rewards[row]} for environment {row} at {at}; give finite rewards")
        return rewards

    def _answer(self, name: str, answer: Any, kind: type) -> Array:
        """A copy of the (B,) numbers or booleans of a user's function; raise if their shape or kind differs."""
        found = np.array(answer)
        right = found.dtype == bool if kind is bool else found.dtype.kind in "fiub"
        if found.shape != (self.num_envs,) or not right:
            wanted = "booleans" if kind is bool else "numbers"
            given = f"{found.dtype} of shape {found.shape}"
            raise InputError(f"{name} must return ({self.num_envs},) {wanted}, got {given}")
        return found.astype(kind, copy=False)


def _read_only(x: Array) -> Array:
    x.flags.writeable = False
    return x


def _stepper_of(source: Any, trust_code: bool) -> ExportedStepper:
    """The compiled header of a run, a file or a stepper."""
    if isinstance(source, Run):
        with tempfile.TemporaryDirectory(prefix="herglotz-") as folder:
            return load_c(export_run(source, Path(folder, "environment.h")))
    if isinstance(source, str | Path):
        return load_c(source, trust_code=trust_code)
    if not isinstance(source, ExportedStepper):
        raise InputError(f"VectorEnv takes a run, the path of a C header or a stepper of one, got {type(source)}")
    return source


def _library_of(stepper: ExportedStepper) -> CLibrary:
    """The compiled functions of a stepper; raise if the stepper cannot be an environment."""
    path, kind, metadata = stepper.path, stepper.kind, stepper.metadata
    terms = input_terms_of(metadata.get("columns", ()))
    refuse({
        f"{path}: VectorEnv steps C headers, got {kind}; export the run as one": not isinstance(stepper.loop, CLibrary),
        f"{path}: the model takes no inputs, so there is no action; fit a recording of a driven motion":
            not stepper.inputs,
        f"{path}: the inputs {', '.join(terms)} follow from others and are no actions; fit without them": bool(terms),
        f"{path}: the header holds no velocities; export it again":
            "velocity" not in stepper.programs,
    })  # fmt: skip
    arrival = metadata.get("arrival", {})
    late = {name: value for name in ("delay", "lag") if (value := arrival.get(name))}
    if late:
        unit = metadata.get("time_unit", "s")
        words = " and ".join(f"a {name} of {value:g} {unit}" for name, value in late.items())
        warnings.warn(f"{path}: recorded inputs act with {words}; an action acts at once", stacklevel=4)
    assert isinstance(stepper.loop, CLibrary)
    return stepper.loop


def _positions(stepper: ExportedStepper) -> tuple[Array, Array]:
    """(n,) lowest and highest observed positions: the box of the data, for an angle at most one turn of it."""
    box, angles = stepper.metadata["box"], np.array(stepper.metadata["angles"], bool)
    high = np.array(box["q_high"]) if box else np.full(stepper.dof, np.inf)
    low = np.array(box["q_low"]) if box else -high
    middle, turns = (low + high) / 2 if box else 0 * angles, angles & (high - low > 2 * np.pi)
    return np.where(turns, middle - np.pi, low), np.where(turns, middle + np.pi, high)


def _input_bounds(stepper: ExportedStepper, low: Any, high: Any) -> tuple[Array, Array]:
    """(m,) bounds of the inputs: the given or the recorded ones."""
    found = []
    for end, given in (("low", low), ("high", high)):
        bound = stepper.metadata.get(f"input_{end}") if given is None else given
        if bound is None:
            raise InputError(f"{stepper.path}: the range of the inputs is not recorded; give input_{end}")
        try:
            array = np.asarray(bound, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != (stepper.inputs,) or not np.isfinite(array).all():
            raise InputError(f"input_{end} must hold {stepper.inputs} finite number(s), one an input, got {bound!r}")
        found.append(array)
    if not (found[0] < found[1]).all():
        bounds = " and ".join(str(x.tolist()) for x in found)
        raise InputError(f"input_low must be below input_high, got {bounds}; give both where an input never changed")
    return found[0], found[1]
