"""Objectives, optimisers and the fit."""

from herglotz.training.choose import choose as choose
from herglotz.training.config import FitConfig as FitConfig
from herglotz.training.fit import fit as fit
from herglotz.training.learned_functions import (
    LearnedFunction as LearnedFunction,
    learned_functions as learned_functions,
)
from herglotz.training.look import Look as Look, look as look
from herglotz.training.plan import Plan as Plan
from herglotz.training.problems.one_step import (
    ResidualProblem as ResidualProblem,
    SupervisedProblem as SupervisedProblem,
)
from herglotz.training.problems.prior import Prior as Prior
from herglotz.training.problems.shooting import ShootingProblem as ShootingProblem
from herglotz.training.problems.smoothing import SmoothingProblem as SmoothingProblem
from herglotz.training.run import Run as Run
from herglotz.training.run_folder import load_run as load_run, save_run as save_run
from herglotz.training.selection import Selection as Selection, select as select
from herglotz.training.smoother import Smoothed as Smoothed, smooth as smooth
from herglotz.training.solvers.adam import adam as adam
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt as levenberg_marquardt
from herglotz.training.trades import Trade as Trade
from herglotz.training.uncertainty import (
    Bands as Bands,
    Laplace as Laplace,
    ensemble_bands as ensemble_bands,
    laplace as laplace,
    traded as traded,
)
