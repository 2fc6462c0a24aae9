"""Speed against accuracy: `tune` finds the cheapest setting within an error, or the most accurate within a budget."""

from herglotz.tune.distil import distil as distil
from herglotz.tune.kick_composition import (
    CompiledKicks as CompiledKicks,
    KickStepper as KickStepper,
    export_kicks_c as export_kicks_c,
    fit_kicks as fit_kicks,
)
from herglotz.tune.local_error import flag_unresolved as flag_unresolved
from herglotz.tune.result import (
    Candidate as Candidate,
    Setting as Setting,
    TuneConfig as TuneConfig,
    Tuning as Tuning,
    pareto as pareto,
)
from herglotz.tune.search import tune as tune
