"""Checks as rows of the table that a report of a run shows."""

from types import SimpleNamespace

from herglotz.report import write
from herglotz.verify.report import Check


def test_checks_that_do_not_apply_are_no_failures(monkeypatch):
    # fails if a claim on something that the run does not have stands as failed, or with the bound it was not held to
    checks = [
        Check.at_most("a", "holds", 1e-3, 1e-2),
        Check.more_than("b", "fails", 1.0, 2.0),
        Check("c", "is of inputs", float("nan"), 1e-2, True, "no inputs", applies=False),
    ]
    monkeypatch.setattr(write, "verify", lambda _run: SimpleNamespace(checks=checks, passed=False))
    words, table = write._verification(None)  # type: ignore[arg-type]
    assert str(words).startswith("NOT verified")
    assert isinstance(table, write.Table)
    assert table.rows == (
        ("holds", "0.001", "≤ 0.01", "ok"), ("fails", "1", "> 2", "FAIL"), ("is of inputs", "–", "", "n/a"),
    )  # fmt: skip
