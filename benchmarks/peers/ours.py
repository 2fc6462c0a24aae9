"""herglotz as a peer: `fit` with the settings given, two positions in."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.stepping import Stepper
from herglotz.training import FitConfig, fit
from herglotz.training.run import Run

from .judging import Metrics, free_run
from .samples import Samples


@dataclass(frozen=True)
class Learned:
    """A fitted stepper as a predictor."""

    run: Run
    h: float

    @property
    def parameters(self) -> int:
        """Number of trained values of the model."""
        return self.run.metrics["parameters"]

    def rollout(self, q0: Tensor, q1: Tensor, steps: int, exact: Tensor | None = None) -> Tensor:  # noqa: ARG002
        """See `rollouts.Predictor`."""
        stepper = Stepper(self.run.model)
        with torch.no_grad():
            out = stepper.rollout(*stepper.init(q0, q1, None, self.h), h=self.h, steps=steps)
        return torch.cat([q0[:, None], out.q], 1)


def train_ours(samples: Samples, seed: int, budget: float) -> Learned:  # noqa: ARG001
    """`herglotz.training.fit` on all samples; the budget is not used: it stops by itself."""
    lengths = [len(q) for q in samples.q]
    t = torch.cat([samples.h * torch.arange(k, dtype=torch.float64) for k in lengths])
    data = Trajectories.of(t, torch.cat(samples.q), lengths, angles=samples.angles, source="peers")
    config = FitConfig(train_fraction=1.0, seed=seed)
    return Learned(fit(data, config, progress=False), samples.h)


def measured(data: Trajectories, seed: int) -> tuple[Metrics, int]:
    """The default fit of a recording, time split included, judged by its own free run; and its parameters."""
    run = fit(data, FitConfig(seed=seed), progress=False)
    cut = run.train_lengths[0]
    return free_run(run.prediction[cut:], run.data.q[cut:]), run.metrics["parameters"]
