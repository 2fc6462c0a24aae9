"""From settings and a first look at the data to a model that a fit starts from."""

from __future__ import annotations

import torch

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig

WIDER = 3  # a single layer reaches a tenth of the error of two in as much time


def dragged(config: FitConfig) -> bool:
    """Whether drag and a constant potential start the fit: where s d·q̇ is in L and nobody said what else is."""
    told = config.features or config.known or config.alike or config.objective == "raw" or config.supervision != "q"
    return config.level == "affine" and not told


def build_model(base: Baseline, config: FitConfig, network: str) -> ContactLagrangian:
    """A model with the network that the objective needs: the correction, the potential's, or a plain one alone.

    Where the whole range is "covered", the correction is one layer of `WIDER` times as many units.
    """
    width = config.correction_width if network != "potential" and config.order == 2 else 0
    width *= WIDER if network == "covered" else 1
    model = ContactLagrangian(
        ModelConfig(
            angles=base.angles,
            level=config.level,
            scale=base.scale,
            speed=base.speed,
            stiffness=base.stiffness if not config.alike else (0.0,) * len(base.angles),
            tilt=base.tilt if not config.alike else (0.0,) * len(base.angles),
            rate=base.rate,
            potential_width=config.potential_width if network == "potential" and config.order == 2 else 0,
            damping_width=config.damping_width,
            correction_width=width,
            correction_depth=1 if network == "covered" else 2,
            baseline=network != "plain",
            seed=config.seed,
            activation=config.activation,
            mass_width=config.mass_width if network != "plain" else 0,
            action_width=config.action_width,
            coulomb=config.coulomb,
            inputs=base.inputs if config.level == "forced" else 0,
            input_map=config.input_map,
            input_zero=config.level == "forced" and base.inputs > 0,
            features=("1", *config.features) if dragged(config) else config.features if network != "plain" else (),
            known=config.known if network != "plain" else (),
            alike=config.alike and network != "plain",
            diagonal=config.diagonal and network != "plain",
            coupled=config.coupled,
            order=config.order,
        )
    )
    if model.inputs and not config.input_map:
        assert model.friction is not None
        model.friction.input_map.data.copy_(
            torch.tensor(base.input_map, dtype=torch.float64).reshape(len(base.angles), -1)
        )
    for name, values in base.start.items():
        flat = model.get_parameter(name).data.view(-1)
        flat[len(flat) - len(values) :] = flat.new_tensor(values)  # order 4 has the baseline's features before these
    return model.to(dtype=config.torch_dtype, device=config.device)
