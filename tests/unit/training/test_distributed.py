"""Two processes share the work and find what one finds."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from herglotz.training import distillation, distributed, flow

ROOT = Path(__file__).resolve().parents[3]
WORK = """
import sys
from pathlib import Path
from dataclasses import replace
import torch
from herglotz.data import simulate
from herglotz.training import distillation, distributed, flow
from herglotz.scenes import scene
from herglotz.training import FitConfig, ResidualProblem, ShootingProblem, SmoothingProblem, fit, levenberg_marquardt
from herglotz.training.baseline import estimate_baseline
from herglotz.training.first_states import first_states
from herglotz.training.problems.grid import segment_grid
from herglotz.training.task import build_model
from herglotz.training.distributed import is_first, process_group
from herglotz.training.problems.prior import prior_of
from tests.unoptimised import leave_out_optimisation

leave_out_optimisation()
distributed.MIN_ROWS = flow.SAMPLES_PER_JOB = 8  # there are few rows, and each process shall have some
distillation.ITERATIONS = 3  # sums are shared from the first iteration on
found = {}
with process_group():
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=16, h=0.2, seed=0)
    for objective, level, optimiser, iterations in (("residual", "affine", "lm", 2), ("raw", "linear", "adam", 2)):
        settings = FitConfig(
            objective=objective, level=level, optimiser=optimiser, iterations=iterations, departures=(1e-3,),
            correction_width=5, damping_width=3, potential_width=4, train_fraction=1.0,
        )
        run = fit(data, settings, progress=False)
        found[objective] = torch.nn.utils.parameters_to_vector(run.model.parameters()).detach()
        found[objective + " cost"] = torch.tensor([row["cost"] for row in run.history], dtype=torch.float64)
    base = estimate_baseline(data)
    model = build_model(base, FitConfig(potential_width=4, level="linear"), "potential")
    noisy = replace(data, q=data.q + 0.01 * torch.sin(1e3 * data.t)[:, None])
    grid, options = segment_grid(noisy, 8, base.model_step), {"sigma": 0.01, "prior": prior_of(model, base, 1e-3)}
    shooting = ShootingProblem(model, noisy, grid, **options)
    start = shooting.pack(shooting.parameters.get(), first_states(shooting, shooting.parameters.get()))
    smoothing = SmoothingProblem(model, noisy, grid, process=0.1, **options)
    for name, problem, x in (("trajectory", shooting, start), ("smoothing", smoothing, smoothing.start())):
        search = levenberg_marquardt(problem, x, max_iterations=3)
        found[name], found[name + " cost"] = search.x, torch.tensor(search.history, dtype=torch.float64)
    assert shooting.compiled is not None and len(shooting.compiled._jobs(0)) > 1
    for segment in (0, grid.segments - 1):  # the first process and the last one run these
        lost = start.clone()
        lost[shooting.places(segment)[-1]] = torch.nan
        found[f"lost {segment}"] = torch.stack([shooting.cost(lost), shooting.normal_equations(lost)[0]])
    if is_first():
        torch.save(found, sys.argv[1])
threads = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]  # Linux
if any("gloo" in name for name in threads):
    sys.exit(f"threads that outlive their process group can abort while Python ends: {threads}")
"""


def worked(monkeypatch, out):
    """Parameters and costs of the fits, with `WORK` run by this process."""
    # `WORK` sets these.
    monkeypatch.setattr(flow, "SAMPLES_PER_JOB", flow.SAMPLES_PER_JOB)
    monkeypatch.setattr(distributed, "MIN_ROWS", distributed.MIN_ROWS)
    monkeypatch.setattr(distillation, "ITERATIONS", distillation.ITERATIONS)
    monkeypatch.setattr(sys, "argv", ["work.py", str(out)])
    exec(WORK, {"__name__": "work"})
    return torch.load(out, weights_only=True)


def by_one_and_by_two(monkeypatch, tmp_path):
    """What this process finds alone while another one starts, which imports everything anew, and what both find."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", WORK, str(tmp_path / "none.pt")]
    second = {**os.environ, **shared, "RANK": "1", "LOCAL_RANK": "1"}
    with monkeypatch.context() as first, subprocess.Popen(command, cwd=ROOT, env=second) as other:
        one = worked(monkeypatch, tmp_path / "1.pt")
        for name, value in {**shared, "RANK": "0", "LOCAL_RANK": "0"}.items():
            first.setenv(name, value)
        two = worked(first, tmp_path / "2.pt")
        assert other.wait(timeout=300) == 0
    assert not (tmp_path / "none.pt").exists()
    return one, two


@pytest.mark.skipif(not torch.distributed.is_available(), reason="this PyTorch has no torch.distributed")
def test_two_processes_find_what_one_finds(tmp_path, monkeypatch):
    # fails if a process's share is left out or counted twice (prior included), a step that fails in one process is not
    # known to the others, or processes take different decisions;
    # or if a process ends while threads of gloo still run: once, on a loaded machine, one aborted
    one, two = by_one_and_by_two(monkeypatch, tmp_path)
    assert one.keys() == two.keys()
    assert len(one) == 10
    print({k: v for k, v in one.items() if k.startswith("lost")})
    assert all(bool(value.isinf().all()) for name, value in one.items() if name.startswith("lost"))
    for name, value in one.items():
        torch.testing.assert_close(two[name], value, rtol=1e-9, atol=1e-9, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.slow
def test_torchrun_runs_the_training_script(tmp_path):
    # fails if the script does not join the process group, both processes write, or they end at another model than one
    for processes in (1, 2):
        launcher = ["-m", "torch.distributed.run", "--nproc-per-node", "2"] if processes == 2 else []
        script = [sys.executable, *launcher, str(ROOT / "train" / "fit.py"), "--config", "demo"]
        done = subprocess.run(
            [*script, "--out", str(tmp_path / str(processes))], capture_output=True, text=True, check=False,
            env={**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[-2000:]
        assert done.stdout.count('"extrapolation_rms"') == 1
    one, two = (torch.load(tmp_path / name / "model.pt", weights_only=True) for name in "12")
    for part in ("parameters", "states"):
        for name, value in one[part].items():
            torch.testing.assert_close(two[part][name], value, rtol=1e-9, atol=1e-9, msg=lambda m, n=name: f"{n}: {m}")
