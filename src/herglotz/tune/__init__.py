"""Speed against accuracy: the setting that meets an error or a budget, and the front it was chosen from."""

from herglotz.tune.config import TuneConfig
from herglotz.tune.distil import distil
from herglotz.tune.result import Candidate, Setting, Tuning, pareto
from herglotz.tune.search import tune

__all__ = ["Candidate", "Setting", "TuneConfig", "Tuning", "distil", "pareto", "tune"]
