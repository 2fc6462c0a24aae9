"""The result of a verification as data, as a table and as JSON."""

from __future__ import annotations

import math
import unicodedata
from dataclasses import asdict, dataclass, field
from html import escape
from textwrap import fill
from typing import Any

# The width of a new terminal window.
COLUMNS = 80


@dataclass(frozen=True)
class Check:
    """One claim, the measured value and its bound.

    `name` is short and stable, for programs, and `statement` is for people. `value` is the largest error of all
    samples, not finite if no sample could be measured; value and bound must satisfy `relation`. If the claim is about
    an object that the target does not have, `applies` is False and the note names the object.
    """

    name: str
    statement: str
    value: float
    bound: float
    passed: bool
    note: str = ""
    relation: str = "<="
    applies: bool = True

    @classmethod
    def at_most(cls, name: str, statement: str, value: float, bound: float, note: str = "") -> Check:
        """Return a check that passes when value ≤ bound; NaN fails."""
        return cls(name, statement, value, bound, value <= bound, note)

    @classmethod
    def more_than(
        cls, name: str, statement: str, value: float, bound: float, note: str = "", also: bool = True
    ) -> Check:
        """Return a check that passes when value > bound and `also` holds."""
        return cls(name, statement, value, bound, also and value > bound, note, ">")

    @classmethod
    def without_object(cls, name: str, statement: str, note: str) -> Check:
        """Return a check of an object that does not exist for this target; the check neither passes nor fails."""
        return cls(name, statement, math.nan, math.nan, True, note, applies=False)

    @property
    def verdict(self) -> tuple[str, str, str]:
        """Return value, bound and result as a table shows them."""
        if not self.applies:
            return "–", "", "n/a"
        sign = "≤" if self.relation == "<=" else self.relation
        return f"{self.value:.3g}", f"{sign} {self.bound:.3g}", "ok" if self.passed else "FAIL"

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary for JSON; a value that is not finite becomes None."""
        value, bound = (x if math.isfinite(x) else None for x in (self.value, self.bound))
        return {**asdict(self), "value": value, "bound": bound}


@dataclass(frozen=True, repr=False)
class Report:
    """All checks of one target; `print` shows the table. `missing` names required checks that could not be judged."""

    target: str
    checks: tuple[Check, ...]
    details: dict[str, Any] = field(default_factory=dict)
    missing: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether there are checks, every one passed, and none is missing."""
        return bool(self.checks) and not self.missing and all(check.passed for check in self.checks)

    def __getitem__(self, name: str) -> Check:
        """Return the check called `name`."""
        for check in self.checks:
            if check.name == name:
                return check
        raise KeyError(f"no check {name!r}; there are {', '.join(c.name for c in self.checks)}")

    def __repr__(self) -> str:
        bad = [check.name for check in self.checks if not check.passed]
        return f"Report({self.target}: {'verified' if self.passed else 'NOT verified, ' + ', '.join(bad)})"

    def __str__(self) -> str:
        return self.table()

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.table())}</pre>"

    def table(self, verdict: str = "") -> str:
        """Return a verdict, an aligned table (claim, measured, bound, ok or FAIL), and the notes of the checks."""
        rows = [("claim", "measured", "bound", "")]
        notes = list(dict.fromkeys(check.note for check in self.checks if check.note))
        for check in self.checks:
            mark = f" [{notes.index(check.note) + 1}]" if check.note else ""
            rows.append((check.statement + mark, *check.verdict))
        widths = [max(_width(row[i]) for row in rows) for i in range(3)]
        lines = [f"{self.target}: {verdict or ('verified' if self.passed else 'NOT verified')}"]
        lines += [
            f"  {_pad(claim, widths[0])}  {value:>{widths[1]}}  {bound:<{widths[2]}}  {verdict}".rstrip()
            for claim, value, bound, verdict in rows
        ]
        if self.missing:
            lines.append(f"  could not be judged: {', '.join(self.missing)}")
        words = [f"[{i}] {note}" for i, note in enumerate(notes, 1)]
        words += [f"Not judged: {self.details['not_judged']}"] if "not_judged" in self.details else []
        lines += [fill(text, COLUMNS, initial_indent="  ", subsequent_indent="      ") for text in words]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON."""
        return {
            "target": self.target,
            "passed": self.passed,
            "details": self.details,
            "missing": list(self.missing),
            "checks": [check.to_dict() for check in self.checks],
        }


def _pad(text: str, width: int) -> str:
    return text + " " * (width - _width(text))


def _width(text: str) -> int:
    """Return the width of a text in columns; a combining character, such as the tilde of Φ̃, has width 0."""
    return sum(not unicodedata.combining(character) for character in text)
