"""What a fit shows while it works, and the log that it leaves."""

import sys
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tqdm import tqdm

import herglotz
from herglotz.errors import InputError
from herglotz.progress import FIRST_TERMS, MORE_TERMS, STAGES, FitBar, ProgressBar, beat, inside, part
from herglotz.training.run_folder import _log
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.stages import Progress, Stages, log_result, tensorboard_log


def optimise(x, callback):
    for k, cost in enumerate((8.0, 2.0)):
        callback(k + 1, cost, x, dict)
    return OptimiserResult(x, 2.0, "done", 2, [8.0, 2.0], {})


def test_lines_of_stages_and_of_iterations(capsys):
    # fails if --verbose says no more than the default, --quiet speaks, or a cost is shown in units of its own
    cases: list[tuple[Progress, list[str]]] = [
        (False, []),
        ("lines", ["b"]),
        ("iterations", ["b, iteration 1", "b, iteration 2", "b"]),
    ]
    lines = []
    for progress, expected in cases:
        Stages(progress, None, "", False).run("b", torch.zeros(1), 9, optimise)
        lines = capsys.readouterr().err.splitlines()
        assert [line.split(":")[0] for line in lines] == expected
    assert lines[1] == "b, iteration 2: cost 0.25 of its start"


def test_a_second_stage_of_a_name_is_run():  # fails if it is given the first one's result, which started elsewhere
    stages, starts = Stages(False, None, "", False), []

    def kept(x, callback):
        starts.append(float(x))
        return optimise(x, callback)

    found = [stages.run("b", torch.full((1,), start), 9, kept) for start in (1.0, 2.0, 3.0)]
    assert starts == [float(result.x) for result in found] == [1.0, 2.0, 3.0]
    assert list(stages.done) == ["b", "b, again", "b, again, again"]


@pytest.fixture
def clock(monkeypatch):
    """[s], which all clocks read."""
    now = [1000.0]
    for name in ("time.time", "tqdm.std.time", "time.monotonic"):
        monkeypatch.setattr(name, lambda: now[0])
    return now


def shown_by(stages):
    """What its bar draws from now on; (text, last line)."""
    written = StringIO()
    stages.bar.ascii, stages.bar.fp, stages.bar.sp = True, written, stages.bar.status_printer(written)
    return lambda: written.getvalue().split("\r")[-1].strip()


def test_one_bar_tells_what_is_left_of_the_fit(clock):
    # fails if a part's share of typical fits is lost, parts of a search inside one are not of its share, or the bar
    # goes back
    stages = Stages(True, None, "", False)
    last, shares = shown_by(stages), []

    @inside()
    def terms(of=(), first=0.0):
        part(FIRST_TERMS)
        assert stages.bar.span[0] == pytest.approx(0.05 + first)
        for inner in of:
            terms(*inner)
        clock[0] += 11.5
        part(MORE_TERMS)
        shares.append(stages.bar.span[0])
        clock[0] += 1.0
        return {}

    with stages.bar as bar:
        clock[0] += 1.0
        beat()
        assert last() == "looking at the data:   0%|          | 00:01, about ? left"
        stages.keep("terms", lambda: terms([((), 0.0)]))
        assert shares == pytest.approx([0.05 + 0.6 * 0.65 * 0.65, 0.05 + 0.6 * 0.65])
        assert bar.expected == pytest.approx(25.0 / (0.05 + 0.6 * 0.65))
        stages.run("b", torch.zeros(1), 9, optimise)
        clock[0] += 20.0
        beat()
        assert last() == "b:  70%|######9   | 00:46, about 00:20 left, cost 0.25 of its start"  # as long again
        clock[0] += 20.0
        bar.part(STAGES, "verdict")
        assert last() == "verdict:  98%|#########7| 01:06, about 00:01 left"  # longer than typical fits
    assert FitBar.under_way is None


def test_a_stage_tells_the_time_of_its_iterations(clock):
    # fails if a stage of 40 short iterations says 5 minutes because a search of 1000 s stood before it, or says nothing
    # where no search stood before it
    stages, left = Stages(progress=True), []

    def slow(x, callback):
        for k in range(40):
            clock[0] += 0.5
            callback(k + 1, 1.0, x, dict)
            left.append(stages.bar.left)
        return OptimiserResult(x, 1.0, "done", 40, [1.0], {})

    with stages.bar:
        stages.run("x", torch.zeros(1), 40, slow)
    assert stages.bar.expected == 0
    assert left[9] == pytest.approx(10 * 0.5)  # as many again as there were
    assert left[29] == pytest.approx(10 * 0.5)  # as many as are left of its bound


class Parabola:
    """½ (x − 1)²."""

    def cost(self, x):
        return 0.5 * (x - 1).square().sum()

    def normal_equations(self, x):
        return self.cost(x), torch.eye(1), x - 1


def test_the_time_of_a_search_goes_on(clock, capsys):
    # fails if a bar stands still for the minutes that a search for terms takes, ends with the first fit in it, goes on
    # being drawn after it, or a search has no line without a terminal
    stages = Stages(progress=True)
    last = shown_by(stages)

    def search():
        Stages().run("of a fit in it", torch.zeros(1), 9, optimise)
        clock[0] += 75.0
        levenberg_marquardt(Parabola(), torch.zeros(1))
        return {}

    with stages.bar:
        stages.keep("terms", search)
        assert last() == "search for terms:  35%|###5      | 01:15, about 02:19 left"
    written = last()
    clock[0] += 75.0
    levenberg_marquardt(Parabola(), torch.zeros(1))
    assert last() == written
    capsys.readouterr()
    Stages("lines").keep("terms", lambda: clock.append(clock.pop() + 2) or {})
    assert capsys.readouterr().err == "search for terms: 2.0 s\n"


def test_the_log_has_every_iteration():  # fails if a stage's name is lost or cut
    history = [{"stage": "horizon 3, τ 1", "iteration": 0, "cost": 8.0}, {"stage": "b", "iteration": 1, "cost": 0.1}]
    assert _log(history).decode() == 'stage,iteration,cost\n"horizon 3, τ 1",0,8.0\nb,1,0.1\n'


def test_the_log_for_tensorboard(monkeypatch, tmp_path):
    # fails if costs come only after the fit, metrics or words do not reach the writer, or a missing TensorBoard is a
    # traceback
    rows = []

    class Writer:
        def __init__(self, folder, flush_secs):
            rows.append((folder, flush_secs))

        def __enter__(self):
            return self

        def __exit__(self, *_):
            rows.append("closed")

        def add_scalar(self, *row):
            rows.append(row)

        def add_text(self, name, text):
            rows.append((name, text))

    metrics = {"train_rms": 0.01, "verdict": "fits", "follows_data": True, "rate": float("nan")}
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer))
    with tensorboard_log(tmp_path) as log:
        stages = Stages(False, None, "", resume=False, log=log)
        for stage in ("noise", "rest"):
            stages.run(stage, torch.zeros(1), 9, optimise)
        assert rows[1:] == [
            ("cost/noise", 8.0, 1),
            ("cost/noise", 2.0, 2),
            ("cost/rest", 8.0, 3),
            ("cost/rest", 2.0, 4),
        ]
        log_result(log, metrics, {"summary": "S", "equation": "E"})
    words = [("summary", "```\nS\n```"), ("equation", "```\nE\n```")]
    assert (rows[0][0], rows[5:]) == (str(tmp_path), [("metrics/train_rms", 0.01, 0), *words, "closed"])
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(InputError, match=r"pip install 'herglotz\[tensorboard\]'"), tensorboard_log(tmp_path):
        pass


@pytest.mark.parametrize("first", [True, False])
def test_a_fit_removes_what_a_killed_one_left(monkeypatch, tmp_path, first):
    # fails if it stays for ever, or another process of torchrun, which holds no lock, takes what the first one writes
    module = sys.modules["herglotz.training.fit"]
    monkeypatch.setattr(module, "is_first", lambda: first)

    def begun(*_):
        raise InterruptedError

    monkeypatch.setattr(module, "_fit", begun)
    names = [".checkpoint.pt.abcdefgh.tmp", ".model.pt.abcdefgh.tmp", ".history.csv.abcdefgh.tmp", ".mine.abcdefgh.tmp"]
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(InterruptedError):
        module.fit([0.0, 1.0, 0.0, -1.0], h=1.0, out=tmp_path)
    assert sorted(x.name for x in tmp_path.iterdir()) == (names[-1:] if first else sorted(names))


def test_bars_have_no_thread_that_python_may_end_in(monkeypatch):
    # fails if a thread of tqdm draws bars: one of twenty commands that Ctrl-C ended aborted with signal 6, for it held
    # stderr while Python ended
    monkeypatch.setattr(tqdm, "monitor", None)  # another library's bar may have one
    bar = ProgressBar(total=2, disable=False, file=StringIO())
    bar.update()
    bar.close()
    assert ProgressBar.monitor is None
    package = Path(herglotz.__file__).parent
    users = [path.name for path in package.rglob("*.py") if "import tqdm" in path.read_text("utf-8")]
    assert users == ["progress.py"]
