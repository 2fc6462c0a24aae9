"""Speed against accuracy: `tune` finds the cheapest setting for an error, or the most accurate one for a budget."""

from herglotz.tune.config import TuneConfig
from herglotz.tune.distil import distil
from herglotz.tune.kick_composition import KickStepper, fit_kicks
from herglotz.tune.kick_composition_c import CompiledKicks, export_kicks_c
from herglotz.tune.local_error import flag_unresolved, local_errors
from herglotz.tune.result import Candidate, Setting, Tuning, pareto
from herglotz.tune.search import tune

__all__ = [
    "Candidate",
    "CompiledKicks",
    "KickStepper",
    "Setting",
    "TuneConfig",
    "Tuning",
    "distil",
    "export_kicks_c",
    "fit_kicks",
    "flag_unresolved",
    "local_errors",
    "pareto",
    "tune",
]
