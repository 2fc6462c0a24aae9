"""Tables of the docs are made by a command from the stored results."""

from benchmarks import doc_tables, work_precision


def test_the_page_holds_what_the_results_hold():
    # fails if results are stored anew and `python benchmarks/doc_tables.py` is not run, or a number is typed in
    assert doc_tables.PAGE.read_text() == doc_tables.filled(), "run python benchmarks/doc_tables.py"


def test_what_a_term_costs_is_against_the_scenes_own():
    # fails if a ratio is turned over, another scene's model is compared with, or a weight of 16 bits counts as a term
    def point(kind, us, error, **more):
        return {"kind": kind, "setting": kind[9:] + ", h 0.5, C float64", "us_per_time": us, "median": error, "h": 0.5,
                "dtype": "float64", "artefact": "C", **more}  # fmt: skip

    own = {"setting": "own model"}
    scenes = {
        "kepler": [point("learned", 4.0, 1e-3, **own), point("learned, level conservative", 2.0, 0.1),
                   point("learned, no correction", 1.0, None), point("learned, bf16 weights", 1.0, 1e-3)],
        "chain": [point("learned", 8.0, 1e-2, **own), point("learned, level conservative", 4.0, 0.1)],
    }  # fmt: skip
    rows = [[x.strip() for x in line.split("|")[1:-1]] for line in work_precision.terms(scenes)[5:]]
    assert [row[1] for row in rows if not row[0]] == ["no damping", "no correction", "no damping"]
    assert [row[2:] for row in rows] == [["2", "0.001", ""], ["1", "0.1", "0.5, 1e+02"], ["0.5", "fails", "0.25, –"],
                                         ["4", "0.01", ""], ["2", "0.1", "0.5, 10"]]  # fmt: skip
