"""The data, settings and record that every stage of a fit shares, and the model that it starts from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.stages import Stages

WIDER = 3  # a single layer has this multiple of units: it reaches a tenth of the error of two layers in the same time
NOISY = 3e-4  # a one-step error above this share of the motion's size is noise: 40 iterations reach it on exact data
LEAST_GRIP = 0.01  # of set-valued friction at the start of a fit, over the typical speed: small beside what is found
EXACT = {"float64": 1e-8, "float32": 1e-5}  # σ of exact data relative to the motion's size; smaller errors are rounding

# Settings of a fit that its model has under the same name.
AS_SET = ("level", "seed", "activation", "mass_width", "action_width", "dissipation", "coulomb", "input_map", "known",
          "alike", "diagonal", "coupled", "drag", "order", "terms", "translations", "absent")  # fmt: skip


@dataclass(frozen=True)
class Task:
    """The data of a fit, the first look at them, its settings, and the record of its stages."""

    data: Trajectories  # what is fitted: the training part without spikes
    base: Baseline
    config: FitConfig
    stages: Stages
    hurried: bool = False  # a fit that only decides among models: iterations that gain less than 1 % end it

    @property
    def size(self) -> float:
        """The largest |q|, in units of q."""
        return max(self.base.scale)

    @property
    def exact(self) -> float:
        """σ of exact data, in units of q."""
        return EXACT[self.config.dtype] * self.size

    def build(self, network: str, seed: int | None = None) -> ContactLagrangian:
        """The model that a fit starts from; see `build_model`."""
        return build_model(self.base, self.config if seed is None else replace(self.config, seed=seed), network)


def drag_starts_the_fit(config: FitConfig) -> bool:
    """Whether drag and a constant potential start the fit: where s d·q̇ is in L and the user does not say what else."""
    other = config.known or config.terms or config.alike or config.objective == "raw" or config.supervision != "q"
    settings = config.features or other
    return config.level == "affine" and not settings


def build_model(base: Baseline, config: FitConfig, network: str) -> ContactLagrangian:
    """A model with the network that the objective needs: the correction, the potential's, or a plain one alone.

    Where the baseline's motions have "covered" the whole range, the correction is one layer of `WIDER` times as many
    units. "none": named terms alone.
    """
    alone, wide, forced = network == "plain", network == "covered", config.level == "forced"
    features = ("1", *config.features) if drag_starts_the_fit(config) else () if alone else config.features
    own = replace(config, mass_width=0, known=(), alike=False, diagonal=False, terms=()) if alone else config
    corrects = network not in ("potential", "none") and config.order == 2
    stiffness, tilt = ((0.0,) * len(base.angles),) * 2 if config.alike else (base.stiffness, base.tilt)
    model = ContactLagrangian(
        ModelConfig(
            angles=base.angles, scale=base.scale, speed=base.speed, stiffness=stiffness, tilt=tilt, rate=base.rate,
            potential_width=config.potential_width if network == "potential" and config.order == 2 else 0,
            damping_width=config.damping_width if network != "none" else 0,
            correction_width=config.correction_width * (WIDER if wide else 1) if corrects else 0,
            correction_depth=1 if wide else 2,
            baseline=not alone,
            inputs=base.inputs if forced else 0,
            input_zero=forced and base.inputs > 0,
            features=features,
            **{name: getattr(own, name) for name in AS_SET},
        )
    )  # fmt: skip
    _start(model, base, config)
    return model.to(dtype=config.torch_dtype, device=config.device)


def _start(model: ContactLagrangian, base: Baseline, config: FitConfig) -> None:
    """Write the baseline's starting values into a model."""
    if model.inputs and not config.input_map:
        assert model.friction is not None
        start = torch.tensor(base.input_map, dtype=torch.float64)
        model.friction.input_map.data.copy_(start.reshape(len(base.angles), -1))
    for name, values in base.start.items():
        numbers = model.get_parameter(name).data.view(-1)
        numbers[len(numbers) - len(values) :] = numbers.new_tensor(values)  # order 4 has the baseline's features first


def with_sticking(model: ContactLagrangian, *, excess: bool = True) -> ContactLagrangian:
    """The model with set-valued dry friction in place of smooth friction, which a fit starts from.

    Friction at 0 has no slope there; its forces start at `LEAST_GRIP` of the typical speed (mass 1) at least. Without
    `excess` the one of breakaway stays as it is: at 0 or below it is none, and no fit moves it.
    """
    other = ContactLagrangian(replace(model.config, sticking=True))
    known, least = dict(model.named_parameters()), LEAST_GRIP * max(model.config.speed)
    with torch.no_grad():
        for name, value in other.named_parameters():
            value.copy_(known[name])
        assert other.friction is not None
        other.friction.coulomb.clamp_(min=least)
        if excess:
            other.friction.breakaway.clamp_(min=least / 100)
    kept = next(model.parameters())
    return other.to(dtype=kept.dtype, device=kept.device)
