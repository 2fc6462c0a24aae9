"""What a fit shows while it works, and the log that it leaves."""

import torch

from herglotz.training.run_folder import _log
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult
from herglotz.training.stages import Stages


def optimise(x, callback):
    for k, cost in enumerate((8.0, 2.0)):
        callback(k + 1, cost, x, dict)
    return OptimiserResult(x, 2.0, "done", 2, [8.0, 2.0], {})


def test_lines_of_stages_and_of_iterations(capsys):
    # fails if --verbose says no more than the default, --quiet speaks, or a cost is shown in units of its own
    for progress, expected in (
        (False, []),
        ("lines", ["b"]),
        ("iterations", ["b, iteration 1", "b, iteration 2", "b"]),
    ):
        Stages(progress, None, "", False).run("b", torch.zeros(1), 9, optimise)
        lines = capsys.readouterr().err.splitlines()
        assert [line.split(":")[0] for line in lines] == expected
    assert lines[1] == "b, iteration 2: cost 0.25 of its start"


def test_one_bar_goes_through_all_stages():  # fails if a stage's unused bound stays in the remaining time
    stages = Stages(True, None, "", False)
    with stages.bar as bar:
        for name, total in (("a", 100), ("b", 9)):
            stages.run(name, torch.zeros(1), total, optimise)
        assert (bar.n, bar.total) == (4, 2 + 9)


def test_the_log_has_every_iteration():  # fails if a stage's name is lost or cut
    history = [{"stage": "horizon 3, τ 1", "iteration": 0, "cost": 8.0}, {"stage": "b", "iteration": 1, "cost": 0.1}]
    assert _log(history).decode() == 'stage,iteration,cost\n"horizon 3, τ 1",0,8.0\nb,1,0.1\n'
