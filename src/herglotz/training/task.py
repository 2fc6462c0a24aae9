"""`Task`: the data, settings and record that every stage of a fit shares, and the model that a fit starts from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.stages import Stages

# Factor on the units of a single layer, which then has a tenth of the error of two layers in the same time.
WIDER = 3
# Share of the motion's size. A larger one-step error is noise: 40 iterations reach this share on exact data.
NOISY = 3e-4
# Least set-valued friction at the start of a fit, over the typical speed: small beside the friction of real joints.
LEAST_GRIP = 0.01
# σ of exact data over the motion's size: smaller errors are rounding.
EXACT = {"float64": 1e-8, "float32": 1e-5}

# Settings of a fit that its `ModelConfig` has under the same name.
AS_SET = ("level", "seed", "activation", "mass_width", "action_width", "dissipation", "coulomb", "input_map", "known",
          "alike", "diagonal", "coupled", "drag", "order", "terms", "translations", "absent")  # fmt: skip


@dataclass(frozen=True)
class Task:
    """The data of a fit (the training part without spikes), their baseline, the settings, and the record of stages.

    A `hurried` fit only compares models, and ends when an iteration gains less than 1 %. Segments have at most
    `longest` recorded steps (0: no limit).
    """

    data: Trajectories
    base: Baseline
    config: FitConfig
    stages: Stages
    hurried: bool = False
    longest: int = 0

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
    """True if drag and a constant potential start the fit: s d·q̇ is in L, and the settings name no other terms."""
    other = config.known or config.terms or config.alike or config.objective == "raw" or config.supervision != "q"
    settings = config.features or other
    return config.level == "affine" and not settings


def build_model(base: Baseline, config: FitConfig, network: str) -> ContactLagrangian:
    """A model with the network that the objective needs.

    "correction" of the step; "covered": a correction of one layer with `WIDER` times as many units, if the motions of
    the baseline cover the whole range; "potential"; "plain": a network as the whole model; "none": only named terms.
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
        # At order 4 the features of the baseline come first, and keep their values.
        numbers = model.get_parameter(name).data.view(-1)
        numbers[len(numbers) - len(values) :] = numbers.new_tensor(values)


def with_sticking(model: ContactLagrangian, *, excess: bool = True) -> ContactLagrangian:
    """The model with set-valued dry friction in place of smooth friction, as the start of a fit.

    The derivative of the motion by a set-valued friction force of 0 is 0, and a fit cannot change the force. Forces
    start at no less than `LEAST_GRIP` of the typical speed (mass 1). Without `excess` that of breakaway stays as it is.
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
