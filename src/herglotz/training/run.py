"""A finished fit, in memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data.anything import split_options
from herglotz.data.checks import check_trajectory
from herglotz.data.holds import Arrival
from herglotz.data.trajectories import GAP, Trajectories
from herglotz.errors import InputError, refuse
from herglotz.mechanics import Driven
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper
from herglotz.stepping.continuous_equation import ContinuousEquation, FractionalStepper
from herglotz.stepping.rollout import OneStepMethod
from herglotz.training.baseline import JITTER
from herglotz.training.config import FitConfig
from herglotz.training.equation import Equation, equation_of, notes_of
from herglotz.training.fitted_run import as_recorded
from herglotz.training.motion import Motion, free_motion
from herglotz.training.plan import Plan
from herglotz.training.predict import Prediction, predict
from herglotz.training.summary import as_html, one_line, summary


@dataclass(frozen=True, repr=False)
class Run:
    """A trained model with everything that is needed to judge it.

    `prediction` holds the model's positions at every sample: the fitted states on the training part, then one free run
    from the last training sample. `rollout`, `predict`, `plot`, `export` and `verify` take and return plain numbers,
    arrays and files; `stepper` is the differentiable stepper behind them.

    Parameters
    ----------
    model, config
        The discrete Lagrangian L_d, and the user's settings: `fit(data, run.config)` gives the same fit.
    metrics, history
        Errors in the data's units, verdict, plan and equation (`docs/trajectory.md`, section 8); cost by iteration.
    data, train_lengths
        All N samples, and the number of leading samples of each trajectory that were trained on.
    states
        q (N, n), p (N, n) and s (N,) at every sample; `stepper.velocity(states, h)` gives v.
    h, box, reading
        Typical model step, in the data's unit of time; lowest and highest q, p, s of the training part, beyond which
        the model extrapolates; the user's options of reading the data (`herglotz.training.run_folder.Reading`).
    """

    model: ContactLagrangian
    config: FitConfig
    metrics: dict[str, Any]
    data: Trajectories
    train_lengths: tuple[int, ...]
    states: State  # (N, n), (N, n), (N,)
    h: float
    box: dict[str, list[float]]
    history: list[dict[str, Any]]
    reading: dict[str, Any] = field(default_factory=dict)

    @property
    def prediction(self) -> Tensor:
        """Predicted positions at every sample, (N, n)."""
        return self.states.q

    def states_at_end(self) -> State:
        """The state at the last sample of every trajectory, (B, n), (B, n), (B,): the start of a forecast."""
        ends = torch.tensor(self.data.lengths).cumsum(0) - 1
        return State(*(x[ends] for x in self.states))

    @property
    def decided(self) -> FitConfig:
        """The settings with the decisions of the plan: level, objective, terms, friction, order, substeps."""
        plan = self.metrics.get("plan")
        return Plan.from_dict(plan).applied(self.config) if plan else self.config

    @property
    def h_range(self) -> tuple[float, float]:
        """The shortest and the longest model step of the fit, widened by 1e-7 for rounded time stamps.

        A tuned model has one step.
        """
        steps, m = self.data.steps().h, self.decided.substeps
        fitted = steps[steps <= GAP * m * self.h]
        if m > 1:
            fitted = fitted / (fitted / (JITTER * self.h) - 1e-6).ceil()
        ends = [self.h, *([] if self.setting else (float(fitted.min()), float(fitted.max())))]
        return min(ends) * (1 - 1e-7), max(ends) * (1 + 1e-7)

    @property
    def arrival(self) -> Arrival:
        """How recorded inputs become the acting inputs `data.u`: hold, delay and lag."""
        plan = self.metrics.get("plan") or {}
        return Arrival(plan.get("hold") or self.data.hold, plan.get("delay", 0.0), plan.get("lag", 0.0))

    @property
    def setting(self) -> dict[str, Any]:
        """The setting of a run that `herglotz tune` wrote (artefact, dtype, tol, …); empty for any other run."""
        return (self.metrics.get("tuned") or {}).get("chosen", {})

    @property
    def stepper(self) -> Stepper:
        """The trained time stepper, with the tuned tolerance of Newton's method if the run was tuned."""
        return Stepper(self.model, tol=self.setting.get("tol"))

    @property
    def continuous(self) -> ContinuousEquation:
        """The continuous equation of the model at its typical step: field, energy H̃, modified Lagrangian L̃."""
        if isinstance(self.model, Driven) and self.data.u is not None:
            raise InputError("the model takes inputs: give them, ContinuousEquation(run.model.at(u), run.h)")
        return ContinuousEquation(self.model, self.h)

    def at_step(self, h: float) -> OneStepMethod:
        """A stepper for any step h > 0 that reproduces the motion of the model at its own step.

        Inside `h_range` that is `stepper`. Elsewhere Φ̃_h = Φ̃_r ∘ Φ̃_H^k for h = kH + r: k typical steps H and a part r
        (`theory.FractionalStepper`, docs/theory.md). UNRESOLVED if the recorded step is too long for the motion.

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
        """The energy H̃(q, p, s) of the model at the given states; dH̃/dt = −(∂H̃/∂s) H̃.

        The power of friction and of other forces changes H̃ as well (section 1 of `docs/mathematics.md`).

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
            If a step from a state to its neighbours fails.
        """
        H = self.continuous.hamiltonian(*state)
        if len(lost := (~torch.isfinite(H)).nonzero()):
            raise InputError(f"no energy at sample {tuple(lost[0].tolist())}: a step beside it fails; leave it out")
        return H

    def equation(self) -> Equation:
        """The learned M q̈ = forces, in the data's units; with ± if all terms are named (docs/tutorials/duffing.md)."""
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
        check_trajectory(trajectory, len(self.data))
        row = self.data.offsets[trajectory] + max(self.train_lengths[trajectory], 1) - 1
        return State(*(x[row].detach() for x in self.states)), float(self.data.t[row])

    def rollout(self, steps: int, **start: Any) -> Motion:
        """Step the model without data. The result is numpy arrays; `run.stepper.rollout` has gradients.

        Parameters
        ----------
        steps
            Number of steps K.
        q0, v0, s0, trajectory
            Start, (..., n), (..., n), (...); default: the last fitted state of `trajectory` (0). s0 is 0 by default; a
            momentum `p0` may replace the velocity v0.
        t0, h
            Time of the start; default: the time of the fitted state, or 0 if q0 is given. Step, in the data's unit of
            time; default: the model's step, or the steps of recorded inputs.
        inputs
            Constant (m,), one per step (K, m), or a recording (path or trajectories) with its own times.

        Returns
        -------
        Motion
            t (K+1,), q, v and p (..., K+1, n), s (..., K+1), status (..., K).

        Raises
        ------
        InputError
            If a shape does not fit the model, or the recording is shorter than the rollout.
        """
        return free_motion(self, steps, **start)

    def predict(self, data: Any, **settings: Any) -> Prediction:
        """Score the model on another recording.

        Parameters
        ----------
        data
            Anything that `fit` takes: a path, a DataFrame, arrays, trajectories.
        **settings
            Options of reading (`herglotz.data.as_trajectories`; `sensor_zeros` replaces the zeros that prediction would
            estimate), and `warmup`, `windows`, `horizon`, `same_zeros` (`herglotz.training.predict`).

        Returns
        -------
        Prediction
            `rms` in the data's units, `failed_steps`, and the predicted motion.

        Raises
        ------
        InputError
            If the recording has other coordinates, units or inputs, or is too short.
        """
        reading, others = split_options(settings)
        others.setdefault("same_zeros", "sensor_zeros" in reading)
        return predict(self, as_recorded(self, data, **reading), **others)

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
        known = _module("plots.theory").NAMED
        refuse({f"there is no figure {name!r}; choose one of {', '.join(known)}": name not in known})
        return known[name](self)

    def save(self, folder: str | Path) -> None:
        """Write the run into a folder with `save_run`, which creates the folder; `herglotz.load_run` reads the run."""
        _module("training.run_folder").save_run(self, folder)

    def export(self, path: str | Path, kind: str | None = None, **settings: Any) -> Path:
        """Write one file that steps the model without this package (`herglotz.export.export_run`).

        Parameters
        ----------
        path
            The file; the suffix .pt2, .onnx, .h, .c or .fmu chooses the format.
        kind
            pt2, onnx, aoti, c, casadi, acados, fmu or fmu2; needed if the suffix does not choose the format.
        **settings
            Settings of the writer of that format, for example `name` in C.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        InputError
            If the kind is unknown, or the optional packages for this kind are not installed.
        """
        return _module("export").export_run(self, path, kind, **settings)

    def verify(self, **settings: Any) -> Any:
        """Measure every identity; `print(run.verify().table())` (`herglotz.verify.verify`)."""
        return _module("verify").verify(self, **settings)

    def symmetries(self, **settings: Any) -> Any:
        """Find affine symmetries (translations, rotations, …) and their momenta J; `print(run.symmetries())`.

        J_{k+1} = c_k J_k within the error of the run's own free run (section 6 of `docs/mathematics.md`).
        """
        return _module("verify").symmetries(self, **settings)

    def report(self, folder: str | Path, against: Any = None) -> list[Path]:
        """Write report.html, which loads nothing from the network, and the same report as report.md.

        Parameters
        ----------
        folder
            Where to write; created if missing.
        against
            Another recording to score the model on: anything that `fit` takes.

        Returns
        -------
        list of Path
            Both files.

        Raises
        ------
        InputError
            If the recording cannot be read, or has other coordinates.
        """
        other = None if against is None else as_recorded(self, against)
        return _module("report").write_report(self, folder, other, name=str(folder))

    def summary(self) -> str:
        """Data, settings, errors, equation and verdict, in a few lines."""
        return summary(self)

    def __repr__(self) -> str:
        return one_line(self)

    def _repr_html_(self) -> str:
        return as_html(self)


def _module(module: str) -> Any:
    """Import a module of the package on first use: most of these modules import `Run`, and a fit needs none of them."""
    return import_module(f"herglotz.{module}")
