"""A model of named terms with its fit to whole trajectories, and what its misfit looks like."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.named_terms import NamedTerms
from herglotz.training.trajectory_fit import TrajectoryFit

COLOURED = 3.0  # standard deviations of white noise's autocorrelation


@dataclass(frozen=True)
class Found:
    """A model of named terms with its fit."""

    terms: NamedTerms
    config: FitConfig
    values: dict
    base: Baseline
    fit: TrajectoryFit
    whole: bool  # every trajectory is one segment
    spread: float  # of q, RMS

    @property
    def rms(self) -> float:
        """Misfit of the data, in units of q."""
        return self.fit.noise

    @cached_property
    def held_out(self) -> Tensor:
        """RMS over held-out blocks of time, (FOLDS,)."""
        return self.fit.held_out_errors()

    @property
    def coloured(self) -> bool:
        """Whether the misfit goes on from sample to sample, by its autocorrelation: white noise has 0 ± 1/√N."""
        problem = self.fit.problem
        r = problem.misfit(self.fit.path)[problem.grid.sample.argsort()]
        together = problem.data.trajectory[1:] == problem.data.trajectory[:-1]
        with_next = (r[1:] * r[:-1]).sum(-1)[together].sum() / r.square().sum().clamp_min(1e-300)
        return float(with_next) > COLOURED / r.numel() ** 0.5
