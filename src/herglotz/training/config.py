"""What a fit is asked to do: plain values, stored beside the result."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch

from herglotz.errors import InputError
from herglotz.models import LEVELS
from herglotz.models.network import ACTIVATIONS
from herglotz.settings import from_plain

OBJECTIVES = ("auto", "residual", "trajectory", "raw")
OPTIMISERS = ("lm", "adam")
DTYPES = {"float64": torch.float64, "float32": torch.float32}


@dataclass(frozen=True)
class FitConfig:
    """Settings of `fit`; the defaults suit measured and simulated data alike.

    Parameters
    ----------
    level
        "conservative" (no damping), "linear" (one damping rate), "affine" (damping depends on position and velocity),
        "full" (on s as well; s at the start is unknown, so fit several seeds) or "forced" (one rate, and friction of
        each joint).
    objective
        "residual": one-step error ‖M⁻¹R‖², for data without noise. "trajectory": multiple shooting, for noisy data.
        "auto": whichever the noise found in the data asks for. "raw": a plain network trained on ‖R‖², which collapses
        (always seen with Adam, at some seeds with Levenberg–Marquardt); for demonstration.
    optimiser
        "lm" (Levenberg–Marquardt), or "adam" for the residual objectives.
    train_fraction
        Part of every trajectory, in time, that is trained on; the rest tests. 1 trains on everything.
    seed
        Of the initial weights.
    dtype, device
        Of the whole fit and of the model it returns.
    iterations
        Bound on the iterations of the residual objectives (Adam takes 20 times as many); each stage of trajectory
        fitting takes 40 at the most.
    departures
        Prior strengths τ tried for the networks' departure from the baseline; held-out blocks of time choose. One
        value fixes it.
    potential_width, damping_width, correction_width
        Hidden units of the networks; the correction is used by the residual objectives, the potential's network by
        trajectory fitting.
    learning_rate
        Of Adam.
    activation
        Of the networks: tanh, softplus or silu.
    mass_width
        Hidden units of a mass that depends on position; 0 for a constant one.
    action_width
        Units of the full level's map of s.
    coulomb
        Dry friction beside the viscous one at the forced level.
    """

    level: str = "linear"
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
    activation: str = "tanh"
    mass_width: int = 0
    action_width: int = 4
    coulomb: bool = False

    def __post_init__(self):
        _choice("level", self.level, LEVELS)
        _choice("objective", self.objective, OBJECTIVES)
        _choice("optimiser", self.optimiser, OPTIMISERS)
        _choice("dtype", self.dtype, tuple(DTYPES))
        _choice("activation", self.activation, ACTIVATIONS)
        if self.coulomb and self.level != "forced":
            raise InputError(f"coulomb is friction of the joints; set level='forced', not '{self.level}'")
        if not 0 < self.train_fraction <= 1:
            raise InputError(f"train fraction must be in (0, 1], got {self.train_fraction:g}")
        if self.iterations < 1:
            raise InputError(f"iterations must be >= 1, got {self.iterations}")
        if not self.departures or min(self.departures) <= 0:
            raise InputError(f"departures must be one or more positive numbers, got {self.departures}")
        if self.optimiser == "adam" and self.objective not in ("residual", "raw"):
            raise InputError(f"adam fits the objectives residual and raw, not {self.objective!r}; use the optimiser lm")
        try:
            device = torch.device(self.device)
        except RuntimeError:
            raise InputError(f"unknown device '{self.device}'; use cpu or cuda") from None
        if device.type == "cuda" and not torch.cuda.is_available():
            raise InputError("device cuda was asked for but PyTorch finds no GPU; use cpu")

    @property
    def torch_dtype(self) -> torch.dtype:
        """The dtype as torch knows it."""
        return DTYPES[self.dtype]

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> FitConfig:
        """Inverse of `to_dict`; unknown keys are an error."""
        return from_plain(cls, values)


def _choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise InputError(f"unknown {name} '{value}'; choose one of {', '.join(choices)}")
