"""A finished fit, in memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data.anything import as_trajectories, split_options
from herglotz.data.holds import Arrival
from herglotz.data.trajectories import GAP, Trajectories
from herglotz.errors import InputError, refuse
from herglotz.mechanics import Driven
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper
from herglotz.stepping.continuous_equation import ContinuousEquation, FractionalStepper
from herglotz.stepping.method import OneStepMethod
from herglotz.training.baseline import JITTER
from herglotz.training.config import FitConfig
from herglotz.training.equation import Equation, equation_of
from herglotz.training.equation_notes import notes_of
from herglotz.training.motion import Motion, free_motion
from herglotz.training.plan import Plan
from herglotz.training.predict import Prediction, predict
from herglotz.training.summary import as_html, one_line, summary


@dataclass(frozen=True, repr=False)
class Run:
    """A trained model with everything that is needed to judge it.

    `prediction` is the model's free run at every sample: on the training part from the fitted states, and from the last
    training sample on without another look at the data. `rollout`, `predict`, `plot`, `export` and `verify` take and
    return plain numbers, arrays and files; `stepper` is the differentiable stepper behind them.

    Parameters
    ----------
    model, config
        The discrete Lagrangian L_d, and the settings that `fit` was told: `fit(data, run.config)` gives the same fit.
        `decided` holds them with what the plan decided.
    metrics, history
        Errors in the data's units, verdict, plan and equation (`docs/trajectory.md`, section 8); cost by iteration.
    data, train_lengths
        All N samples, and how many leading ones of each trajectory were trained on.
    states
        q (N, n), p (N, n) and s (N,) at every sample; `stepper.velocity(states, h)` has v.
    h, box, reading
        Typical step, in the data's unit of time; lowest and highest q, p, s of the training part; how data were read.
    """

    model: ContactLagrangian
    config: FitConfig
    metrics: dict[str, Any]
    data: Trajectories  # all samples, training and test
    train_lengths: tuple[int, ...]  # leading samples of each trajectory that were trained on
    states: State  # (N, n), (N, n), (N,) at every sample
    h: float  # typical model step
    box: dict[str, list[float]]  # range of q, p, s over the training part: where the model can be trusted
    history: list[dict[str, Any]]  # stage, iteration, cost
    reading: dict[str, Any] = field(default_factory=dict)  # what was told of reading the data (`Reading`)

    @property
    def prediction(self) -> Tensor:
        """Predicted positions at every sample, (N, n)."""
        return self.states.q

    def states_at_end(self) -> State:
        """Return the state at the last sample of every trajectory, (B, n), (B, n), (B,), to go on from."""
        last = [first + length - 1 for first, length in zip(self.data.offsets, self.data.lengths, strict=True)]
        return State(*(x[last] for x in self.states))

    @property
    def decided(self) -> FitConfig:
        """The settings with what the plan decided: level, objective, terms, friction, order, substeps."""
        plan = self.metrics.get("plan")
        return Plan.from_dict(plan).applied(self.config) if plan else self.config

    @property
    def h_range(self) -> tuple[float, float]:
        """The shortest and the longest step that the model was fitted to, with a hair for rounded time stamps.

        A tuned model is made for one step.
        """
        steps, m = self.data.steps().h, self.decided.substeps
        fitted = steps[steps <= GAP * m * self.h]
        if m > 1:
            fitted = fitted / (fitted / (JITTER * self.h) - 1e-6).ceil()
        ends = [self.h, *([] if self.setting else (float(fitted.min()), float(fitted.max())))]
        return min(ends) * (1 - 1e-7), max(ends) * (1 + 1e-7)

    @property
    def arrival(self) -> Arrival:
        """What happens to recorded inputs before they act: hold, delay and lag; `data.u` is what acts."""
        plan = self.metrics.get("plan") or {}
        return Arrival(plan.get("hold") or self.data.hold, plan.get("delay", 0.0), plan.get("lag", 0.0))

    @property
    def setting(self) -> dict[str, Any]:
        """Return the setting of a run that `herglotz tune` wrote (artefact, dtype, tol, …); empty for any other run."""
        return (self.metrics.get("tuned") or {}).get("chosen", {})

    @property
    def stepper(self) -> Stepper:
        """The trained time stepper, with Newton's tolerance as tuned."""
        return Stepper(self.model, tol=self.setting.get("tol"))

    @property
    def continuous(self) -> ContinuousEquation:
        """The continuous equation of the model at its typical step: field, energy H̃, modified Lagrangian L̃."""
        if isinstance(self.model, Driven) and self.data.u is not None:
            raise InputError("the model takes inputs: give them, ContinuousEquation(run.model.at(u), run.h)")
        return ContinuousEquation(self.model, self.h)

    def at_step(self, h: float) -> OneStepMethod:
        """The model's motion at any step h > 0: a stepper, exact for the motion that the model has at its own step.

        Inside `h_range` it is `stepper`. Elsewhere Φ̃_h = Φ̃_r ∘ Φ̃_H^k for h = kH + r: steps of the typical H and a part
        (`theory.FractionalStepper`, docs/theory.md), UNRESOLVED where the recorded step is too long for the motion.

        Parameters
        ----------
        h
            The step, in the data's unit of time.

        Returns
        -------
        OneStepMethod
            `step(state, h)` and `rollout(q, p, s, h=h, steps=K)`.

        Raises
        ------
        InputError
            If h is not positive, or the model takes inputs.
        """
        refuse({f"h must be > 0, got {h:g}": not h > 0})
        if self.h_range[0] <= h <= self.h_range[1]:
            return self.stepper
        tolerance = {torch.float32: 1e-3, torch.float64: 1e-6}[self.states.q.dtype]
        return FractionalStepper(self.continuous, tolerance=tolerance)

    def energy(self, state: State) -> Tensor:
        """The energy H̃(q, p, s) of the model at states; dH̃/dt = −(∂H̃/∂s) H̃.

        With friction or other forces H̃ changes by their power, too (section 1 of `docs/mathematics.md`).

        Parameters
        ----------
        state
            q, p (..., n) and s (...).

        Returns
        -------
        Tensor
            (...), in units of p q̇: the first coordinate's mass is 1.

        Raises
        ------
        InputError
            If the neighbours of a state cannot be stepped to.
        """
        H = self.continuous.hamiltonian(*state)
        if len(lost := (~torch.isfinite(H)).nonzero()):
            raise InputError(f"no energy at sample {tuple(lost[0].tolist())}: a step beside it fails; leave it out")
        return H

    def equation(self) -> Equation:
        """M q̈ = forces as learned, in the data's units; ± where all terms are named (docs/tutorials/duffing.md)."""
        known = self.metrics.get("equation")
        return Equation.from_dict(known) if known else equation_of(self, None, notes_of(self))

    def last_fitted(self, trajectory: int = 0) -> tuple[State, float]:
        """State and time at the last training sample of a trajectory.

        Parameters
        ----------
        trajectory
            Its number, from 0.

        Returns
        -------
        State, float
            With shapes (n,), (n,), (); the time is the data's.

        Raises
        ------
        InputError
            If there is no such trajectory.
        """
        if not 0 <= trajectory < len(self.data):
            raise InputError(f"there is no trajectory {trajectory}; choose one from 0 to {len(self.data) - 1}")
        row = self.data.offsets[trajectory] + max(self.train_lengths[trajectory], 1) - 1
        return State(*(x[row].detach() for x in self.states)), float(self.data.t[row])

    def rollout(self, steps: int, **start: Any) -> Motion:
        """Step the model alone; numpy arrays come out, without gradients (`run.stepper.rollout` has gradients).

        Parameters
        ----------
        steps
            Number of steps K.
        q0, v0, s0, trajectory
            Start, (..., n), (..., n), (...); left out, the last fitted state of this trajectory (0). s0 is 0 by
            default; a momentum `p0` may stand in the place of the velocity v0.
        t0, h
            Time of the start; left out, that of the fitted state, or 0. Step, in the data's unit of time; left out, the
            model's own, or those of recorded inputs.
        inputs
            Held (m,), a step each (K, m), or a recording (path or trajectories) whose inputs act at their own times.

        Returns
        -------
        Motion
            t (K+1,), q, v and p (..., K+1, n), s (..., K+1), status (..., K).

        Raises
        ------
        InputError
            If shapes do not fit the model, or a recording does not cover the rollout.
        """
        return free_motion(self, steps, **start)

    def predict(self, data: Any, **settings: Any) -> Prediction:
        """Score the model on another recording.

        Parameters
        ----------
        data
            Anything that `fit` takes: a path, a DataFrame, arrays, trajectories.
        **settings
            How to read it (`herglotz.data.as_trajectories`; with `sensor_zeros` no others are taken off), and `warmup`,
            `windows`, `horizon`, `same_zeros` (`herglotz.training.predict`).

        Returns
        -------
        Prediction
            `rms` in the data's units, `failed_steps`, and the predicted motion.

        Raises
        ------
        InputError
            If the recording is not of the same coordinates, units and inputs, or is too short.
        """
        reading, others = split_options(settings)
        others.setdefault("same_zeros", "sensor_zeros" in reading)
        return predict(self, as_trajectories(data, like=self.data, **reading), **others)

    def plot(self, name: str = "trajectory") -> Any:
        """A matplotlib `Figure`; `savefig` writes it.

        Parameters
        ----------
        name
            trajectory, phase_portrait, learned, training, plan, sizes, momentum_vs_dS or hj_residual.

        Returns
        -------
        Figure
            In the units of the data.

        Raises
        ------
        InputError
            If there is no figure of that name.
        """
        known = _asked("plots.theory").NAMED
        refuse({f"there is no figure {name!r}; choose one of {', '.join(known)}": name not in known})
        return known[name](self)

    def save(self, folder: str | Path) -> None:
        """Write the run into a folder, made if missing, as `save_run` does; `herglotz.load_run` reads it."""
        _asked("training.run_folder").save_run(self, folder)

    def export(self, path: str | Path, kind: str | None = None, **settings: Any) -> Path:
        """Write one file that steps without this package (`herglotz.export.export_run`).

        Parameters
        ----------
        path
            The file; .pt2, .onnx, .h, .c and .fmu say what is written.
        kind
            pt2, onnx, aoti, c, casadi, acados, fmu or fmu2, where the name of the file does not say it.
        **settings
            Of the writer of that kind, such as `name` in C.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            If the kind is not known, or its extra is missing.
        """
        return _asked("export").export_run(self, path, kind, **settings)

    def verify(self, **settings: Any) -> Any:
        """Measure every identity; `print(run.verify().table())` (`herglotz.verify.verify`)."""
        return _asked("verify").verify(self, **settings)

    def symmetries(self, **settings: Any) -> Any:
        """Find translations, rotations and other affine symmetries, and what they keep; `print(run.symmetries())`.

        J_{k+1} = c_k J_k within the error of the run's own free run (section 6 of `docs/mathematics.md`).
        """
        return _asked("verify").symmetries(self, **settings)

    def report(self, folder: str | Path, against: Any = None) -> list[Path]:
        """Write report.html, which fetches nothing, and its twin report.md.

        Parameters
        ----------
        folder
            Where to write; made if missing.
        against
            Another recording to score the model on: anything that `fit` takes.

        Returns
        -------
        list of Path
            Both files.

        Raises
        ------
        InputError
            If the recording cannot be read, or is not of the same coordinates.
        """
        other = None if against is None else as_trajectories(against, like=self.data)
        return _asked("report").write_report(self, folder, other, name=str(folder))

    def summary(self) -> str:
        """What was reached, in a few lines."""
        return summary(self)

    def __repr__(self) -> str:
        return one_line(self)

    def _repr_html_(self) -> str:
        return as_html(self)


def _asked(module: str) -> Any:
    """A module that fits do without, loaded when a run is asked for something of it; most of them know runs."""
    return import_module(f"herglotz.{module}")
