"""`benchmarks/worst_case.py`: what it counts, and how it tells it."""

from benchmarks import worst_case
from tests.compilers import needs_compiler


@needs_compiler
def test_counts_of_a_short_run(monkeypatch):
    # fails if failed steps or evaluations are not counted, or a quantile is taken of the wrong side; no time is judged
    box = {f"{name}_{end}": [x] for name in "qps" for end, x in (("low", -1.0), ("high", 1.0))}
    monkeypatch.setattr(worst_case, "box_of", lambda *_: box)  # that of motions takes seconds
    monkeypatch.setattr(worst_case, "FLAGS", ("-std=c99", "-O1"))
    found = worst_case.times("driven mass, dry friction", True, 1000)
    assert found["failed"] == 0
    assert 1 <= found["evaluations_median"] <= found["evaluations_q9999"] <= found["evaluations_worst"] <= 31
    assert found["evaluations_worst"] > 3  # steps that begin to stick or to slip take more than the others
    assert 0 < found["median"] <= found["q9999"] <= found["worst"]


def test_the_table_has_ratios_of_the_median():
    # fails if a time is divided by another one, or the part of a board that was not there is shown
    row = {"model": "a", "states": "random", "steps": 10**7, "failed": 2, "median": 100, "q9999": 150, "worst": 420}
    row |= {"evaluations_median": 3, "evaluations_q9999": 4, "evaluations_worst": 5}
    text = worst_case.table([row], [])
    assert "| a | random | 1e+07 | 100 ns | 1.50 × | 4.20 × | 3, 4, 5 | 2 |" in text
    assert "Cortex" not in text
    small = {"model": "a", "flash": 1, "ram": 2, "stack": 3, "mean": 4, "most": 5}
    assert worst_case.table([row], [small]).endswith("| a | 1 | 2 | 3 | 4, 5 |")
