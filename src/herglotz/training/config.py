"""Settings of a fit, stored beside its result."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from difflib import get_close_matches
from typing import Any

import torch

from herglotz.choices import LEVELS, OBJECTIVES, OPTIMISERS, ROBUST, SUPERVISION
from herglotz.data import Trajectories
from herglotz.errors import InputError, refuse
from herglotz.models.network import ACTIVATIONS
from herglotz.models.term import TERMS
from herglotz.schema import from_plain

DTYPES = {"float64": torch.float64, "float32": torch.float32}
CHOICES = {
    "level": ("auto", *LEVELS), "objective": OBJECTIVES, "optimiser": OPTIMISERS, "robust": ROBUST,
    "supervision": SUPERVISION, "dtype": tuple(DTYPES), "activation": ACTIVATIONS,
}  # fmt: skip


@dataclass(frozen=True)
class FitConfig:
    """Settings of `fit`; the defaults suit measured and simulated data alike.

    Parameters
    ----------
    level
        "conservative" (no damping), "linear" (one damping rate), "affine" (damping depends on position and velocity),
        "full" (on s as well; s at the start is unknown, so fit several seeds) or "forced" (one rate, and friction of
        each joint). "auto": "forced" with dry friction if inputs u are recorded, else "linear". With default settings
        the data choose the structure for two or three coordinates with an angle among them, or several without
        (`herglotz.training.structure`).
    objective
        "residual": one-step error ‖M⁻¹R‖², for data without noise. "trajectory": multiple shooting, for noisy data.
        "smoothing": every state is an unknown and every step has a little noise, for noisy data that no model follows
        for long (pushes, chaos). "auto": "residual" or "trajectory", by the noise found in the data. "raw": a plain
        network trained on ‖R‖², which collapses (always with Adam, at some seeds with Levenberg–Marquardt); for
        demonstration.
    optimiser
        "lm" (Levenberg–Marquardt), or "adam" or "adamw" for the residual objectives.
    train_fraction
        Leading share of every trajectory that is trained on, dimensionless; the rest is the test part. 1: no test part.
    seed
        Seed of the initial weights.
    dtype, device
        Type and place of the whole fit and of the fitted model. The run of your own L_d is on the CPU after the fit.
    iterations
        Most iterations of the residual objectives (Adam takes 20 times as many); a stage of trajectory fitting takes at
        most 40.
    restarts
        Random initialisations of the one-step objective; the best after 30 iterations is kept. None: 4 if the
        correction is a single layer (`baseline_motion`), else 1.
    departures
        Candidate prior strengths τ, dimensionless, for the networks' departure from the baseline; held-out blocks of
        time choose one. A single value fixes it.
    potential_width, damping_width, correction_width
        Hidden units of the networks. The residual objectives use the correction, trajectory fitting the potential's
        network. The correction has two layers, or one with three times as many units if the baseline's equation of
        motion explains exact data and its motions fill their holes (`herglotz.training.baseline_motion`).
    learning_rate
        Learning rate of Adam, dimensionless.
    batch
        Triples of samples in one step of Adam; None: all. For levels whose motion has no s, or with s recorded.
    activation
        Activation of the networks: tanh, softplus or silu.
    mass_width
        Hidden units of a mass that depends on position; 0: constant mass.
    action_width
        Units of the full level's map of s.
    dissipation
        Powers of s in L beside −γ s, "s^2" and "s^3", each with a learned coefficient: damping that depends on s. For
        the level forced, and for the level full, whose networks they replace.
    coulomb
        Dry friction beside viscous friction, at the forced level.
    sticking
        Set-valued dry friction, with which a joint can stand still (`herglotz.stepping.newton`). Whole trajectories
        are fitted, from a start with smooth friction. None: if a search for named terms finds dry friction, and
        set-valued friction is as likely (`herglotz.training.search`).
    robust
        Loss of trajectory fitting. "on": Student's t, with little influence of outliers. "off": least squares. "auto":
        Student's t if the residuals of least squares have more outliers than noise explains. Single spikes of the
        training data are left out beforehand, unless "off".
    find_zeros
        The zeros of the sensors may differ from recording to recording. They are fitted together with the named terms
        and kept if they improve the score of held-out blocks (`herglotz.training.sensor_zeros`); the search for terms
        is then repeated. None: if named terms miss whole trajectories by more than the noise. True: always. False:
        never.
    find_input_terms
        Try inputs that act by their square, size or rate as well, or saturate (`herglotz.data.input_terms`), if named
        terms miss the data by more than the noise.
    supervision
        Recorded quantities that the one-step objective is fitted to: "q" (positions), "qs" (and s) or "qps" (and
        momenta), recorded at every sample. The unit of s and p is fitted. With s known the full level is reliable.
    use_inputs
        Drive the model with the recorded inputs u (forced level); False leaves the inputs out of the fit.
    input_delay, actuator_lag
        Delay of the inputs, and time constant of the actuator, in the data's unit of time (`herglotz.data.driving`).
        None: stated in the data, else the values that explain the accelerations best (`herglotz.training.hold`). 0: no
        delay, no lag.
    input_map
        The map G from inputs to forces, n · m numbers row by row, if known; empty: learned. Forces are in units in
        which the first coordinate's mass is 1: for one joint of inertia J, a torque has G = 1/J.
    features
        Terms of L = K − V beside those of the level, as text: `"cos(q1 - q2) v1 v2"`, part of K;
        `"(q2 - q1)^4 + (q3 - q2)^4"`, without velocities part of V; or one of the names chain, sites, central,
        pendulums, harmonics, revolute, lengths. Each has one learned coefficient. See `herglotz.models.features`.
    known
        Known terms of K and V, as text with their numbers (the first mass is 1): `"-9.81 cos(q1)"` is a pendulum's V.
        They are not learned.
    alike
        All coordinates share one mass, and their potential has only features: chains.
    diagonal
        Each coordinate has its own mass, and the mass matrix is diagonal: separate bodies, no joints.
    coupled
        Viscous friction of speed differences at the forced level: links with hinges between them.
    terms
        Further parts of the potential and of the forces, by their names in `herglotz.models.TERMS` (docs/extending.md).
    frequencies
        Angular frequencies ν, in rad per unit of time, of a periodic force with learned amplitude and phase: cos νt and
        sin νt become the inputs (`herglotz.data.input_terms`). For data without inputs.
    translations
        Symmetries of L_d, each a set of coordinates that move together: `"q1 + q2"`, or `"q1"` alone. No learned term
        depends on their common position. `run.symmetries()` finds them (`herglotz.models.translations`).
    drag
        Forces beside viscous friction, each with a learned coefficient (forced level): "|v1| v1", "q1^2 v1", "|v1|"
        (viscous friction that differs by direction), "|v| v" (a body in air), "(v1 - v2)" (a damper between two
        coordinates; "(20.5 v1 - v2)" where these move in proportion), "load 1", "cos(q1) sgn(v1)" (dry friction
        that changes with the position), "u1 cos(q1)" (an input that acts through the position), and "u1^2 v1" (one
        that brakes). See `herglotz.models.drag`.
    order
        4: a rule of order 4 from the features, without networks. The parameters are then those of the continuous
        motion, and remain valid at other steps.
    absent
        Numbers of the model that are 0 and not learned: "potential.tilt[0]" (`herglotz.models.numbers_of`).
    substeps
        Model steps per recorded step, in trajectory fitting, for samples too far apart for one step of the rule.
    """

    level: str = "auto"
    objective: str = "auto"
    optimiser: str = "lm"
    train_fraction: float = 0.667
    seed: int = 0
    dtype: str = "float64"
    device: str = "cpu"
    iterations: int = 400
    departures: tuple[float, ...] = (2e-4, 6e-4, 2e-3, 6e-3)
    potential_width: int = 8
    damping_width: int = 6
    correction_width: int = 16
    learning_rate: float = 3e-3
    batch: int | None = None
    activation: str = "tanh"
    mass_width: int = 0
    action_width: int = 4
    dissipation: tuple[str, ...] = ()
    coulomb: bool = False
    sticking: bool | None = None
    robust: str = "auto"
    find_zeros: bool | None = None
    find_input_terms: bool = True
    supervision: str = "q"
    restarts: int | None = None
    use_inputs: bool = True
    input_delay: float | None = None
    actuator_lag: float | None = None
    input_map: tuple[float, ...] = ()
    features: tuple[str, ...] = ()
    known: tuple[str, ...] = ()
    alike: bool = False
    diagonal: bool = False
    coupled: bool = False
    terms: tuple[str, ...] = ()
    translations: tuple[str, ...] = ()
    frequencies: tuple[float, ...] = ()
    drag: tuple[str, ...] = ()
    order: int = 2
    substeps: int = 1
    absent: tuple[str, ...] = ()

    def __post_init__(self):
        own = {name: getattr(self, name) for name in (*CHOICES, "restarts", "iterations", "substeps", "batch")}
        refuse({
            f"unknown {name} '{own[name]}'; choose one of {', '.join(choices)}": own[name] not in choices
            for name, choices in CHOICES.items()
        })  # fmt: skip
        refuse({
            f"{name} must be >= 1, got {value}": value is not None and value < 1
            for name, value in own.items() if name not in CHOICES
        })  # fmt: skip
        self._check_together()
        self._check_device()

    def _check_together(self) -> None:
        forces = self.coulomb or self.sticking or self.input_map or self.drag
        objective = self.objective
        refuse({
            f"train fraction must be in (0, 1], got {self.train_fraction:g}": not 0 < self.train_fraction <= 1,
            f"departures must be one or more positive numbers, got {self.departures}":
                not self.departures or min(self.departures) <= 0,
            f"supervision '{self.supervision}' needs the one-step objective; set objective='residual', not "
            f"'{objective}'": self.supervision != "q" and objective not in ("auto", "residual"),
            f"{self.optimiser} fits the objectives residual and raw, not {objective!r}; use the optimiser lm":
                self.optimiser != "lm" and objective not in ("residual", "raw"),
            f"substeps need trajectory fitting, not the objective {objective!r}; set it to 'trajectory'":
                self.substeps > 1 and objective not in ("trajectory", "smoothing"),
            f"sticking friction is fitted to trajectories; leave objective='{objective}' out":
                self.sticking and objective not in ("auto", "trajectory"),
            f"coulomb, sticking, drag and input_map are forces; set level='forced', not '{self.level}'":
                forces and self.level not in ("forced", "auto"),
            f"dissipation adds powers of s to L; set level='full' or 'forced', not '{self.level}'":
                self.dissipation and self.level not in ("full", "forced", "auto"),
            "set-valued friction cannot be combined with powers of s; leave sticking or dissipation out":
                self.dissipation and self.sticking,
            "input_map is given but use_inputs is False; leave one of them out":
                self.input_map and not self.use_inputs,
            "batch applies only to adam and adamw; lm takes all rows: set the optimiser, or leave batch out":
                self.batch and self.optimiser == "lm",
            f"batch: the level '{self.level}' carries s along whole trajectories; leave batch out, or record s and set "
            "supervision='qs'": self.batch and self.level in ("affine", "full") and self.supervision == "q",
        })  # fmt: skip

    def _check_device(self) -> None:
        try:
            device = torch.device(self.device)
        except RuntimeError:
            raise InputError(f"unknown device '{self.device}'; use cpu or cuda") from None
        if device.type == "cuda" and not torch.cuda.is_available():
            raise InputError("device cuda was asked for but PyTorch finds no GPU; use cpu")
        if device.type not in ("cpu", "cuda"):
            raise InputError(f"device {self.device} has no float64, in which fits are made; use cpu or cuda")

    def resolved(self, data: Trajectories) -> FitConfig:
        """The settings of a fit to these data, with the level chosen.

        Raises
        ------
        InputError
            If the data hold inputs that the level cannot take, or the size of the map of the inputs does not fit.
        """
        where, driven = data.source or "data", self.use_inputs and data.u is not None
        config = self
        if self.level == "auto":
            level = "forced" if driven or self.has_forces() else "full" if self.dissipation else "linear"
            config = replace(self, level=level, coulomb=self.coulomb or driven)
        if self.sticking or any("sgn(" in text for text in self.drag):
            config = replace(config, coulomb=True)
        if driven and self.dissipation and self.objective == "auto":
            config = replace(config, objective="trajectory")
        inputs, count = data.u.shape[1] if driven and data.u is not None else 0, len(self.input_map)
        refuse({
            f"{where}: holds inputs u, which the level '{config.level}' cannot take; set level='forced' or 'auto', "
            "or use_inputs=False to leave them out": driven and config.level != "forced",
            f"{where}: the one-step objective has no work of inputs in s; set objective='trajectory', or leave "
            "dissipation out": driven and self.dissipation and config.objective == "residual",
            f"{where}: input_map needs n · m = {data.dof} · {inputs} numbers, row by row; got {count}":
                count not in (0, data.dof * inputs),
        })  # fmt: skip
        return config

    def has_forces(self) -> bool:
        """True if the settings ask for forces, which only the forced level has."""
        named = any(TERMS[name].has_force() for name in self.terms if name in TERMS)
        return bool(self.coulomb or self.coupled or self.sticking or self.drag or named)

    def changed(self, settings: dict[str, Any]) -> FitConfig:
        """These settings with some replaced; a single text or number stands for a list of one.

        Raises
        ------
        InputError
            If a setting does not exist; the message names the nearest.
        """
        known = [f.name for f in fields(self)]
        for name in settings:
            if name not in known:
                near = get_close_matches(name, known, 1)
                hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
                raise InputError(f"unknown setting {name!r} of a fit; {hint}")
        as_list = lambda x: (x,) if isinstance(x, (str, int, float)) else tuple(x)  # noqa: E731
        lists = {name for name in settings if isinstance(getattr(self, name), tuple)}
        return replace(self, **settings | {name: as_list(settings[name]) for name in lists})

    @property
    def torch_dtype(self) -> torch.dtype:
        """The dtype as a `torch.dtype`."""
        return DTYPES[self.dtype]

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> FitConfig:
        """Inverse of `to_dict`; unknown keys are an error."""
        return from_plain(cls, values)
