"""Objectives, optimisers and the fit."""

from herglotz.training.choose import choose
from herglotz.training.config import FitConfig
from herglotz.training.fit import fit
from herglotz.training.identifiability import Trade, traded
from herglotz.training.look import Look, look
from herglotz.training.plan import Plan
from herglotz.training.problems.one_step import ResidualProblem
from herglotz.training.problems.prior import Prior
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.smoothing import SmoothingProblem
from herglotz.training.problems.supervised import SupervisedProblem
from herglotz.training.run import Run
from herglotz.training.run_folder import load_run, save_run
from herglotz.training.selection import Selection, select
from herglotz.training.smoother import Smoothed, smooth
from herglotz.training.solvers.adam import adam
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.uncertainty import Bands, Laplace, ensemble_bands, laplace

__all__ = [
    "Bands",
    "FitConfig",
    "Laplace",
    "Look",
    "OptimiserResult",
    "Plan",
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
    "choose",
    "ensemble_bands",
    "fit",
    "laplace",
    "levenberg_marquardt",
    "load_run",
    "look",
    "save_run",
    "select",
    "smooth",
    "traded",
]
