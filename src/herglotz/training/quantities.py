"""The physical parameters of a run by their names in mechanics, with units and standard deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass

from herglotz.training.equation_words import unit_of
from herglotz.training.run import Run
from herglotz.training.trades import WORDS
from herglotz.training.uncertainty import PHYSICAL, Laplace

INPUT_MAP = "friction.input_map"
# Each parameter's unit is this power of the coordinate's unit over that of time; the first coordinate's mass is 1.
DIMENSIONS = {
    "potential.stiffness": (0, 2),
    "potential.tilt": (1, 2),
    "damping.rate": (0, 1),
    "friction.viscous": (0, 1),
    "friction.coulomb": (1, 2),
    "friction.breakaway": (1, 2),
    "friction.log_smooth": (1, 1),
    "friction.log_stribeck": (1, 1),
    INPUT_MAP: (1, 2),
}
# Widths of dry friction, which exceed the sharpest one by the exponential of the parameter (`Friction.widths`).
WIDTHS = ("friction.log_smooth", "friction.log_stribeck")
# Parameters stored as logarithms, with the power of the exponential: the mass is the square of its factor's entry C.
LOGARITHMS = {"kinetic.log_diagonal": 2, "friction.log_smooth": 1, "friction.log_stribeck": 1}


@dataclass(frozen=True)
class Quantity:
    """One physical number: name of the parameter, words with the coordinate, unit ("" if none), value, deviation."""

    name: str
    words: str
    unit: str
    value: float
    std: float

    def __str__(self) -> str:
        return f"{rounded(self.value, self.std)} ± {self.std:.2g} {self.unit}".rstrip()


def rounded(value: float, std: float) -> str:
    """The value to the second digit of its standard deviation, at most five digits, with a minus sign."""
    digits = 5
    if value and math.isfinite(value) and 0 < std < math.inf:
        digits = 2 + math.floor(math.log10(abs(value))) - math.floor(math.log10(std))
    return ("−" if value < 0 else "") + f"{abs(value):.{min(max(digits, 1), 5)}g}"


def quantities(posterior: Laplace, run: Run) -> list[Quantity]:
    """Every learned entry of the physical parameters, with the name of its coordinate."""
    std, found = posterior.standard_deviations(), []
    for name, i in posterior.problem.parameters.entries:
        if not name.startswith(PHYSICAL):
            continue
        values = run.model.get_parameter(name).detach().reshape(-1)
        words = WORDS.get(name, name)
        whose = f" of {run.data.names[i]}" if len(values) == run.data.dof > 1 else ""
        # The first mass is 1 and no parameter.
        if name == "kinetic.log_diagonal":
            whose = _of_mass(run, i + 1)
        if name == INPUT_MAP and len(values) > 1:
            whose = f", from {_source(run, i)[0]} to {run.data.names[i // run.model.inputs]}"
        spread = float(std[name].reshape(-1)[i])
        value = float(values[i])
        if (power := LOGARITHMS.get(name)) is not None:
            value = math.exp(power * value)
            spread *= power * value
        if name in WIDTHS:
            value += float(run.model.get_buffer("friction.sharpest")[i])
        found.append(Quantity(name, words + whose, _unit(name, run, i), value, spread))
    return found


def _of_mass(run: Run, i: int) -> str:
    """Whose C_ii² of m = C Cᵀ is: the mass, or the effective mass while the coordinates before i are free."""
    names = run.data.names
    free = "" if run.model.config.diagonal else f" while {', '.join(names[:i])} {'is' if i == 1 else 'are'} free"
    return f" of {names[i]}{free}, over that of {names[0]}"


def _unit(name: str, run: Run, i: int) -> str:
    if name == "friction.input_zero":
        return run.data.input_labels[i][1]
    if name == "kinetic.log_diagonal":
        own, first = run.data.units[i + 1], run.data.units[0]
        return "" if own == first or "1" in (own, first) else f"{first}²/{own}²"
    if name not in DIMENSIONS or run.data.time_unit in ("", "1"):
        return ""
    row, per = i, ""
    if name == INPUT_MAP:
        row, (of, unit) = i // run.model.inputs, _source(run, i)
        per = f" per {unit or of}"
    length, time = DIMENSIONS[name]
    return unit_of(run.data.units[min(row, run.data.dof - 1)], length, run.data.time_unit, time) + per


def _source(run: Run, i: int) -> tuple[str, str]:
    """Name and unit of the input of entry i of the map from inputs to forces, counted row by row."""
    return run.data.input_labels[i % run.model.inputs]
