"""The judge: rows are kept, limited and measured one by one; a comparison notices what got worse, and nothing else."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import harness, judge
from benchmarks.judging import catalogue, job, make, recorded, scoring, tables
from benchmarks.judging.catalogue import Row
from benchmarks.judging.running import Ended, Judge, environment, false_verdict, limited

ROOT = Path(__file__).resolve().parents[3]


def row(name: str = "a", parts: Any = (1.0, 1.1, 0.9, 1.0), **changed: Any) -> dict[str, Any]:
    """A measured row."""
    error = float(np.sqrt(np.mean(np.square(parts)))) if None not in parts else None
    made = {"name": name, "error": error, "relative": 0.01, "spread": 100.0, "groups": {"test": list(parts)}}
    made |= {"unit": "over noise", "verdict": "noise", "false": "", "exit": 0, "cpu_s": 10.0, "peak_mb": 300}
    return made | {"asks": True, "trouble": "", "said": "", "commit": "abc"} | changed


def result(*rows: dict[str, Any], commit: str = "abc") -> dict[str, Any]:
    return {"commit": commit, "date": "2026-01-01", "machine": "none", "limit_s": 600.0, "rows": list(rows)}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"parts": (1.2, 1.3, 1.1, 1.2)}, "error × 1.2"),
        ({"parts": (None, 1.1, 0.9, 1.0)}, "error × inf"),
        ({"false": "praised"}, "false verdict: praised, noise"),
        ({"cpu_s": 14.0}, "time × 1.4"),
        ({"exit": 3, "false": "rejected", "verdict": "no fit"}, "false verdict: rejected, no fit"),
    ],
)
def test_a_worse_row_is_noticed(changed, said):
    # fails if an error, a verdict or a time that got worse passes, or a row that was not reached counts as good
    assert [x[: len(said)] for x in tables.complaints(row(), row(**changed))] == [said]
    text, worse = tables.compared(result(row(), row("b")), result(row(**changed), row("b"), commit="def"))
    assert (worse, said in text, "abc → def" in text) == (1, True, True)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (row(), row(parts=(1.05, 1.15, 0.95, 1.05))),
        (row(), row(parts=(0.5, 0.5, 0.5, 0.5), cpu_s=3.0)),
        (row(parts=(1.0, 1.0, 1.0, 5.0)), row(parts=(0.95, 1.0, 0.98, 6.2))),  # one recording decides: no evidence
        (row(parts=(1e-9,) * 4), row(parts=(9e-5,) * 4)),  # 1e-6 of the spread is 1e-4
        (row(parts=(None, 1.0)), row(parts=(None, 1.0))),
        (row(cpu_s=3.0), row(cpu_s=4.9)),  # starting Python takes as long
        (row(false="praised"), row(false="praised")),
    ],
)
def test_what_is_not_worse_is_left_alone(old, new):
    # fails if noise of an error, rounding, or what was wrong before is called worse
    assert tables.complaints(old, new) == []


def test_a_missing_row_is_noticed():
    # fails if a row that was left out or skipped passes for a good one; one that is new is no complaint
    assert tables.complaints(row(), None) == ["missing"]
    assert tables.complaints(row(), {"name": "a", "skipped": "no data"}) == ["missing: no data"]
    text, worse = tables.compared(result(row(), row("b")), result(row(), row("c")))
    assert (worse, "| b |" in text, "**missing**" in text) == (1, True, True)


def test_verdicts_of_rows_without_an_error_are_compared():
    # fails if the fit of all runs, of which nothing is left to predict, may be refused in silence
    old, new = (row(asks=False, groups={}, error=None, exit=code, verdict=word) for code, word in
                ((0, "noise"), (None, "no result in 600 s")))  # fmt: skip
    assert tables.complaints(old, new) == ["verdict noise → no result in 600 s"]
    assert tables.complaints(new, old) == []


def test_the_command_compares_and_exits(tmp_path, capsys):
    # fails if a script cannot tell by the exit code that a row is worse
    paths = [tmp_path / f"{name}.json" for name in ("old", "new")]
    for path, cpu in zip(paths, (10.0, 50.0), strict=True):
        harness.store(path, result(row(cpu_s=cpu)))
    compare = ["--compare", *map(str, paths)]
    assert judge.main(compare) == 1
    assert "* worse: a: time × 5" in capsys.readouterr().out
    assert judge.main(["--compare", str(paths[1]), str(paths[0])]) == 0
    rows = tmp_path / "rows.jsonl"  # fails if a run that goes on has to end before it is compared
    rows.write_text(json.dumps(row(cpu_s=10.0)) + "\n", encoding="utf-8")
    assert judge.main(["--compare", str(rows), str(paths[1])]) == 1
    # fails if rows that nobody asks for count: a quick run has no others
    assert judge.main(["--compare", str(rows), str(paths[1]), "--quick"]) == 0
    assert judge.main(["--compare", str(rows), str(paths[1]), "--only", "b"]) == 0


def test_the_table_has_every_row(tmp_path):
    # fails if a row is left out, what was not reached looks like a number, or a reason for a skipped row is lost
    path = tmp_path / "t.json"
    found = result(row(), row("b", parts=(None,)), {"name": "c", "skipped": "no c.csv in data"})
    harness.store(path, found, tables.report(found))
    text = path.with_suffix(".md").read_text(encoding="utf-8")
    assert "| a | 1 | over noise | 0.01 | noise |  | 0 | 10.0 | 300 |" in text
    assert "| b | not reached |" in text
    assert "* c: no c.csv in data" in text
    assert json.loads(path.read_text(encoding="utf-8"))["rows"][1]["error"] is None


def test_a_run_goes_on_where_it_stopped(tmp_path):
    # fails if a row that is done is measured again, a line cut short ends the run or takes the next one with it, a
    # skipped row stays skipped, or rows of two commits share a table
    path, measured = tmp_path / "rows.jsonl", []
    wanted = [Row(name, "recorded:demo") for name in "abcd"]
    lines = [
        json.dumps(row("a")),
        json.dumps({"name": "b", "skipped": "x", "commit": "abc"}),
        json.dumps(row("c"))[:40],
    ]
    path.write_text("\n".join(lines), encoding="utf-8")

    def one(of: Row) -> dict[str, Any]:
        measured.append(of.name)
        return row(of.name)

    judge.measure(wanted, judge.kept(path, "abc"), path, 1, one, "abc")
    assert measured == ["b", "c", "d"]
    assert list(judge.kept(path, "abc")) == ["a", "b", "c", "d"]
    with pytest.raises(SystemExit, match="take another --out"):
        judge.kept(path, "def")


def test_a_process_that_computes_too_long_is_ended(tmp_path):
    # fails if a fit that never ends holds up the judge, or its end is taken for a crash
    ended = limited([sys.executable, "-c", "while True: pass"], 1, environment(None), tmp_path)
    assert ended.code is None
    assert 0.5 < ended.cpu < 3.0  # the kernel looks once in a tick, and by whole seconds
    ended = limited([sys.executable, "-c", "raise SystemExit('why')"], 5, environment(None), tmp_path)
    assert (ended.code, ended.last) == (1, "why")


def test_memory_is_that_of_the_process_alone(tmp_path):
    # fails if a fit counts the memory of the judge, which starts it, or not its own
    code = (
        "import sys; from pathlib import Path; from benchmarks.judge import environment; "
        "from benchmarks.judging.running import limited; print(*(limited([sys.executable, '-c', f'bytearray({size})'], "
        "5, environment(None), Path(sys.argv[1])).peak for size in (0, 300_000_000)))"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    small, large = map(float, done.stdout.split())
    assert small < 50  # 20 measured: that of the judge, which a child has until it becomes the command
    assert large == pytest.approx(286 + 10, abs=20)


def test_the_judge_does_without_torch():
    # fails if the judge loads torch: each of its children would be counted from there
    code = "import sys, benchmarks.judge; sys.exit('torch' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.mark.parametrize(
    ("error", "relative", "code", "attainable", "false"),
    [
        (1.0, 0.01, 0, 1.0, ""), (1.0, 0.01, 3, 1.0, "rejected"), (20.0, 0.05, 0, 1.0, ""),
        (20.0, 0.5, 0, 1.0, "praised"), (20.0, 0.5, 3, 1.0, ""), (None, None, 0, 1.0, "praised"),
        (None, None, 3, 1.0, ""), (4.0, 0.2, 0, 3.0, ""), (0.3, 0.01, 3, None, ""), (0.3, 0.2, 0, None, "praised"),
    ],
)  # fmt: skip
def test_a_false_verdict_is_known(error, relative, code, attainable, false):
    # fails if praise of a useless model passes, a good one may be rejected, or what no model reaches counts as false
    made = {"asks": True, "exit": code, "error": error, "relative": relative}
    assert false_verdict(made, attainable) == false
    assert false_verdict(made | {"asks": False}, attainable) == ""


@pytest.mark.parametrize(
    ("sentence", "name"),
    [
        ("fits to the noise: free runs …", "noise"), ("fits, worse than the noise by a factor of 2: …", "worse"),
        ("does not fit: too little was recorded to tell; …", "too little"),
        ("does not fit beyond the recording", "no fit"), ("", "none"), ("splendid", "other"),
    ],
)  # fmt: skip
def test_verdicts_have_classes(sentence, name):
    # fails if a rejection is read as praise
    assert scoring.verdict_class(sentence) == name


def test_parts_of_a_free_run():
    # fails if samples that the model was shown count, recordings are mixed up, or NaN is averaged away
    q = torch.arange(10.0)[:, None]
    model = q + torch.tensor([9.0, 9, 1, 1, 9, 9, 9, 2, 2, torch.nan])[:, None]
    pairs = scoring.pairs_of(model, q, (4, 6), (2, 3))
    assert scoring.errors(pairs, np.array([0.5])) == [2.0, np.inf]
    assert scoring.errors(pairs[:1], np.array([1.0])) == [1.0]
    assert scoring.pairs_of(model, q, (4, 6), (4, 6)) == []
    assert scoring.plain({"x": [1.23456, np.inf]}) == {"x": [1.235, None]}


def judged(tmp_path, monkeypatch, code: int | None, score: str = "") -> dict[str, Any]:
    """A row whose command ends like this."""

    def python(_self: Judge, module: list[str], _limit: float, _folder: Path) -> Ended:
        if module[0] == "benchmarks.judging.make":
            make.main(*module[1:])
            return Ended(0, 1.0, 1.0, "", "")
        return Ended(0, 1.0, 1.0, score, "") if "scoring" in module[0] else Ended(code, 7.0, 200.0, "", "one\ntwo")

    monkeypatch.setattr(Judge, "_python", python)
    return Judge(tmp_path / "data", tmp_path / "work", 600, {}).row(Row("demo", "recorded:demo"))


def test_a_row_without_a_run_says_why(tmp_path, monkeypatch):
    # fails if a fit that was refused, died or took too long has an error, or stands there without a word
    for code, verdict in ((2, "refused"), (None, "no result in 600 s"), (-11, "ended with -11")):
        found = judged(tmp_path, monkeypatch, code)
        assert (found["verdict"], found["error"], found["exit"], found["false"]) == (verdict, None, code, "")
        assert (found["said"], found["cpu_s"], found["peak_mb"], found["asks"]) == ("two", 7.0, 200, True)


def test_a_row_with_a_run_is_scored(tmp_path, monkeypatch):
    # fails if the score of a run is lost, or its verdict is not held against its error
    score = {
        "error": 50.0,
        "relative": 0.4,
        "verdict": "noise",
        "said": "fits",
        "groups": {},
        "spread": 1.0,
        "trouble": "",
    }
    found = judged(tmp_path, monkeypatch, 0, "warning\n" + json.dumps(score))
    assert {name: found[name] for name in score} == score
    assert found["false"] == "praised"


def test_a_run_of_the_demonstration_is_read_by_public_names(tmp_path):
    # fails if a job's error is not that of the run's own free run over what it did not see, in units of the job
    import herglotz as hz

    run = hz.fit(ROOT / "data" / "demo_pendulum.csv", progress=False)
    run.save(tmp_path / "run")
    trial = job.Trial(str(ROOT / "data" / "demo_pendulum.csv"))
    asked = job.Job("x.csv", [trial], scale=0.003, unit="over noise", size=[1.0])
    found = scoring.scored(asked, tmp_path / "run")
    later = float(np.sqrt(np.mean(np.square(found["groups"]["later"]))))
    assert later == pytest.approx(run.metrics["extrapolation_rms"] / 0.003, rel=1e-3)  # parts differ by a sample
    assert found["error"] == max(later, scoring.rms(found["groups"]["demo_pendulum"]))
    assert found["relative"] == pytest.approx(0.003 * found["error"])
    assert (found["verdict"], found["trouble"], len(found["groups"]["demo_pendulum"])) == ("noise", "", 4)
    wrong = scoring.scored(job.Job("x.csv", coordinates=["phi"]), tmp_path / "run")
    assert (wrong["error"], wrong["trouble"]) == (None, "coordinates theta")


def test_rows_have_names_of_their_own():
    # fails if two rows share a folder, a row cannot be made by its name, or the quick ones name none
    every = catalogue.rows(30)
    assert len({each.folder for each in every}) == len(every)
    assert all(catalogue.named(each.name) == each for each in every if each.name.startswith(("zoo", "open", "law")))
    assert set(catalogue.QUICK) <= {each.name for each in catalogue.rows()}
    assert not set(catalogue.FRESH_DRAWS) & set(catalogue.KNOWN_DRAWS)


def test_a_case_is_tested_by_what_belongs_to_it(tmp_path, monkeypatch):
    # fails if a recording is judged by the test of another reading of it, or absent data are an error
    monkeypatch.setattr(recorded, "CASES", tmp_path)
    with pytest.raises(harness.Absent, match=r"no expected\.json in c"):
        recorded.case(tmp_path, "c", "")
    home = tmp_path / "c"
    home.mkdir()
    for name in ("train", "train_two", "train_small", "test", "test_wide", "test_small"):
        (home / f"{name}.csv").touch()
    (home / "expected.json").write_text('{"reference": {"free_run_rms": 0.5}, "noise": 0.1}', encoding="utf-8")
    tests = {
        train: [Path(x.data).stem for x in recorded.case(home, "c", train).trials] for train in ("", "_two", "_small")
    }
    assert tests == {"": ["test", "test_wide"], "_two": ["test", "test_wide"], "_small": ["test_small"]}
    assert recorded.case(home, "c", "").scale == 0.5


def test_a_process_that_waits_for_ever_is_ended(tmp_path, monkeypatch):
    # fails if a fit that hangs without computing holds up the judge
    monkeypatch.setattr("benchmarks.judging.running.WALL", 0.2)
    ended = limited([sys.executable, "-c", "import time; time.sleep(60)"], 2, environment(None), tmp_path)
    assert ended.code is None
    assert ended.cpu < 1.0
