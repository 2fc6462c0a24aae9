"""Objectives, optimisers and the fit."""

from herglotz.training.adam import adam
from herglotz.training.config import FitConfig
from herglotz.training.fit import fit
from herglotz.training.identifiability import Trade, traded
from herglotz.training.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.prior import Prior
from herglotz.training.residual import ResidualProblem
from herglotz.training.run import Run, load_run, save_run
from herglotz.training.selection import Selection, select
from herglotz.training.shooting import ShootingProblem
from herglotz.training.smoother import Smoothed, smooth
from herglotz.training.smoothing import SmoothingProblem
from herglotz.training.supervision import SupervisedProblem
from herglotz.training.uncertainty import Bands, Laplace, ensemble_bands, laplace

__all__ = [
    "Bands",
    "FitConfig",
    "Laplace",
    "OptimiserResult",
    "Prior",
    "ResidualProblem",
    "Run",
    "Selection",
    "ShootingProblem",
    "Smoothed",
    "SmoothingProblem",
    "SupervisedProblem",
    "Trade",
    "adam",
    "ensemble_bands",
    "fit",
    "laplace",
    "levenberg_marquardt",
    "load_run",
    "save_run",
    "select",
    "smooth",
    "traded",
]
