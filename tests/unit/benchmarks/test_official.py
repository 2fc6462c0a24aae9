"""Official protocols: which samples train and test, what the metric leaves out, what is written."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks import harness, official
from benchmarks.harness import Absent
from herglotz.data import Trajectories
from herglotz.errors import InputError

SILVERBOX = 131_072  # samples of the record


def csv(path, q, u, h=0.1):
    path.parent.mkdir(parents=True, exist_ok=True)
    table = np.c_[h * np.arange(len(q)), q, u]
    np.savetxt(path, table, "%.9g", ",", header="t[s],q[m],u[N]", comments="")


@pytest.fixture
def record(tmp_path):
    """A Silverbox file somewhere below the folder, in which every sample is its own number."""
    n = np.arange(SILVERBOX)
    path = tmp_path / "anywhere" / "SNLS80mV.csv"
    path.parent.mkdir()
    np.savetxt(path, np.c_[-n, n], "%d", ",", header="V1, V2", comments="")
    return tmp_path


def test_silverbox_is_cut_at_the_official_samples(record):
    # fails if a range of the record is off by a sample, if input and output change places, or if the step is another
    train, tests = official.split("silverbox", record, validation=False)
    ends = {name: (int(x.q[0]), int(x.q[-1]), x.samples) for name, x in {"train": train, **tests}.items()}
    assert ends == {
        "train": (40_650, 105_711, 65_062),
        "multisine": (105_712, 127_399, 21_688),
        "arrow full": (100, 40_574, 40_475),
        "arrow no extrapolation": (100, 32_099, 32_000),
    }
    assert train.u is not None
    assert torch.equal(train.u, -train.q)
    assert train.typical_step == pytest.approx(1 / 610.35)
    fitted, held = official.split("silverbox", record, validation=True)
    assert (int(fitted.q[-1]), int(held["validation"].q[0])) == (90_649, 90_650)
    assert int(held["validation"].q[-1]) == 105_711


def test_files_of_ranges_are_taken_as_they_are(tmp_path):
    # fails if a file that holds a range alone is cut again, or if the test without extrapolation is another part
    for name, count in (("estimation", 60), ("multisine", 30), ("arrow_full", 32_010)):
        csv(tmp_path / "silverbox" / f"silverbox_{name}.csv", np.arange(count), np.zeros(count))
    train, tests = official.split("silverbox", tmp_path, validation=False)
    assert train.samples == 60
    assert {name: x.samples for name, x in tests.items()} == {
        "multisine": 30, "arrow full": 32_010, "arrow no extrapolation": 32_000,
    }  # fmt: skip


def test_a_record_that_is_too_short_is_refused(tmp_path):
    # fails if a damaged or other file of the same name is scored as if it were the official one
    csv(tmp_path / "silverbox_estimation.csv", np.arange(9), np.zeros(9))
    with pytest.raises(InputError, match=r"has 9 samples, the official split ends at 50000"):
        official.split("silverbox", tmp_path, validation=True)
    (tmp_path / "SNLS80mV.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="the columns are a, b; V1 and V2 are needed"):
        official.split("silverbox", tmp_path, validation=False)


def test_prepared_folders_are_read(tmp_path):
    # fails if outputs are taken for inputs, if the rate is left out, or if files of a part are joined to one recording
    h5py = pytest.importorskip("h5py", reason="HDF5 is read by h5py, of the extra `tables`")
    for part, count in (("train", 2), ("test", 1)):
        for k in range(count):
            path = tmp_path / "robot_forward" / part / f"{k}.hdf5"
            path.parent.mkdir(parents=True, exist_ok=True)
            with h5py.File(path, "w") as file:
                file.attrs["fs"] = 10
                for j in range(2):
                    file[f"u{j}"], file[f"y{j}"] = np.full(5, 10.0 + j), np.full(5, float(j))
    train, tests = official.split("robot_forward", tmp_path, validation=False)
    assert train.lengths == (5, 5)
    assert train.typical_step == pytest.approx(0.1)
    assert train.u is not None
    assert (train.q[0].tolist(), train.u[0].tolist()) == ([0.0, 1.0], [10.0, 11.0])
    assert tests["test"].lengths == (5,)
    with pytest.raises(Absent, match="no official validation part"):
        official.split("robot_forward", tmp_path, validation=True)


def test_matlab_files(tmp_path, monkeypatch):
    # fails if the reference is taken for the position, if Silverbox' input and output change places, or if the file's
    # own time is not the one that counts
    column = {"t": 3 + 0.001 * np.arange(5), "qm": np.arange(5), "qg": np.ones(5), "vir": -np.arange(5)}
    stored = {
        "DATA_EMPS.mat": {name: x[:, None] for name, x in column.items()},
        "SNLS80mV.mat": {"V1": -np.arange(5)[None], "V2": np.arange(5)[None]},
        "other.mat": {"V1": np.arange(5)[None]},
    }
    scipy = SimpleNamespace(loadmat=lambda path: stored[Path(path).name])
    monkeypatch.setattr(official, "_package", lambda *_: scipy)
    for name, h in (("DATA_EMPS.mat", 0.001), ("SNLS80mV.mat", 1 / 610.35)):
        data = official.read(tmp_path / name)
        assert data.q[:, 0].tolist() == [0, 1, 2, 3, 4]
        assert data.u is not None
        assert torch.equal(data.u, -data.q)
        assert data.t.tolist() == pytest.approx([h * k for k in range(5)])
    with pytest.raises(InputError, match="holds no V2; it is not the file of the benchmark"):
        official.read(tmp_path / "other.mat")


def run_of(every=1, failed=0.0, rms=0.002):
    """A run that says how it was asked to predict."""
    asked = {}

    def predict(_test, **settings):
        asked.update(settings)
        return SimpleNamespace(rms=rms, every=every, failed_steps=failed)

    return SimpleNamespace(predict=predict), asked


def test_the_metric():
    # fails if another warm-up than the official one starts the model, if the unit is not the metric's, if a run that
    # ends before the test has a score, or if a thinned test is scored
    test = Trajectories.of(torch.arange(9.0), torch.zeros(9), source="it")
    run, asked = run_of()
    assert official.score(run, test, official.PROTOCOLS["emps"]) == pytest.approx(2.0)  # type: ignore[arg-type]
    assert asked == {"warmup": 20}
    official.score(run, test, official.PROTOCOLS["silverbox"])  # type: ignore[arg-type]
    assert asked == {"warmup": 50}
    assert official.score(run_of(failed=0.1)[0], test, official.PROTOCOLS["emps"]) is None  # type: ignore[arg-type]
    with pytest.raises(InputError, match="it: every 2 samples were predicted, the protocol asks for all"):
        official.score(run_of(every=2)[0], test, official.PROTOCOLS["emps"])  # type: ignore[arg-type]


def fits(monkeypatch, network):
    """Fits that take no time, and their settings."""
    made = []

    def fit(data, config, **_):
        made.append((data.samples, config.seed, config.train_fraction))
        run, _ = run_of(rms=0.001 * (1 + config.seed))
        metrics = {"plan": {"network": network}, "verdict": "fits to the noise: all of it"}
        return SimpleNamespace(predict=run.predict, metrics=metrics, equation=lambda: "q″ = −q")

    monkeypatch.setattr(official, "fit", fit)
    return made


def test_what_is_written(tmp_path, monkeypatch, capsys):
    # fails if the fit is given less than the training part, if a fit that draws nothing is repeated, if one that draws
    # is not, or if what was measured before is lost
    csv(tmp_path / "in" / "emps_estimation.csv", np.arange(80), np.zeros(80))
    csv(tmp_path / "in" / "emps_test.csv", np.arange(40), np.zeros(40))
    monkeypatch.setitem(official.PROTOCOLS, "emps", dataclasses.replace(official.PROTOCOLS["emps"], cut=60))
    made = fits(monkeypatch, "none")
    words = [str(tmp_path / "in"), "--out", str(tmp_path)]
    assert official.main(words) == 0
    assert made == [(80, 0, 1.0)]
    made = fits(monkeypatch, "potential")
    assert official.main([*words, "--seeds", "3", "--validation"]) == 0
    assert made == [(60, seed, 1.0) for seed in range(3)]
    rows = json.loads((tmp_path / "official.json").read_text())["rows"]
    assert [one["rms"] for one in rows["emps"]["seeds"]] == [{"pulses": 1.0}]
    assert [one["rms"]["validation"] for one in rows["emps, validation"]["seeds"]] == [1.0, 2.0, 3.0]
    table = (tmp_path / "official.md").read_text()
    assert "| emps | pulses | 80 | 40 | 20 | 1 mm | nothing is drawn |" in table
    assert "| emps | validation | 60 | 20 | 20 | 2 (1 – 3) mm | 3 seeds |" in table
    assert "silverbox: skipped, none of SNLS80mV.mat, SNLS80mV.csv" in capsys.readouterr().out


def test_nothing_to_measure(tmp_path, monkeypatch, capsys):
    # fails if a training part alone is scored on itself, or if nothing measured ends like a success
    csv(tmp_path / "emps_estimation.csv", np.arange(80), np.zeros(80))
    made = fits(monkeypatch, "none")
    assert official.main([str(tmp_path), "--only", "emps", "--out", str(tmp_path)]) == 1
    assert not made
    assert (
        "emps: skipped, none of DATA_EMPS_PULSES.mat, emps/test/*.hdf5, emps_[!e]*.csv, its test"
        in capsys.readouterr().out
    )
    assert not (tmp_path / "official.json").exists()
    with pytest.raises(SystemExit):
        official.main([str(tmp_path / "nowhere")])


@pytest.mark.parametrize(
    ("values", "text"), [((None,), "failed"), ((2.0, None), "2, 1 failed"), ((1.0, 4.0), "2.5 (1 – 4)")]
)
def test_a_failed_seed_is_said(values, text):
    # fails if the median hides seeds that failed
    assert harness.spread(values, ".3g") == text


def test_a_real_fit(tmp_path):
    # fails if metrics, equation or prediction of a run are not called what the benchmark calls them
    h, q, v = 0.1, [0.0], 0.0
    u = np.repeat(np.random.default_rng(0).normal(size=20), 8)
    for force in u[:-1]:
        x = q[-1]
        for _ in range(50):
            v += h / 50 * (force - 2 * x - 0.4 * v)
            x += h / 50 * v
        q.append(x)
    q = q + 5e-4 * np.random.default_rng(1).normal(size=len(q))  # half a millimetre: a search of exact data is long
    csv(tmp_path / "emps_estimation.csv", q[:100], u[:100])
    csv(tmp_path / "emps_pulses.csv", q[100:], u[100:])
    assert official.main([str(tmp_path), "--only", "emps", "--out", str(tmp_path)]) == 0
    (row,) = json.loads((tmp_path / "official.json").read_text())["rows"]["emps"]["seeds"]
    assert row["named_terms"]
    assert row["rms"]["pulses"] < 2  # mm; the motion is 600 mm wide
