"""What `measured.py` measures of machines with encoders: which samples train, and which are predicted, with defaults.

* motor_axis: every fifth sample of the EMPS axis, 25 s: the first two thirds train, `Run.predict` scores the free run
  over the last third; then all of it trains, and is predicted from its own first samples. A seed is another fifth.
* duffing_circuit: 10 000 samples of the Silverbox train, the next 10 000 are predicted. A seed is another start.
* two_joints: 21 windows of the UW double pendulum train, five are predicted. A seed is another five.
* two_motors: every fourth sample of two runs of the DFKI double pendulum train, windows of the third are predicted. A
  seed is another fourth of the samples. The authors' identified model errs by 0.013, 0.024 and 0.029 rad over these
  windows of 0.25, 0.5 and 1 s.

Trained models do not depend on the seed of a fit, for named terms start from a linear problem.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from herglotz.data import Trajectories, load
from herglotz.training import FitConfig, Run, fit

MOTOR_AXIS = "emps/emps_estimation.csv"
DUFFING_CIRCUIT = "silverbox/silverbox_estimation.csv"
TWO_JOINTS = "uw_double_pendulum/uw_double_pendulum_estimation.csv"
TWO_MOTORS = tuple(f"dfki_double_pendulum/sys_id_{name}.csv" for name in ("00", "02", "04"))
AXIS_EVERY, MOTORS_EVERY = 5, 4
PART, APART = 10_000, 8_000  # samples of the circuit that train; between the starts of two seeds
LEFT_OUT = 5  # windows of the joints
WINDOWS, HORIZONS = 120, (0.25, 0.5, 1.0)  # of the motors, s


def rows(folder: Path, *parts: tuple[str, slice]) -> Trajectories:
    """These samples of these files, each a recording, as a user would give them: as a table of its own."""
    with tempfile.TemporaryDirectory() as made:
        path, sets = Path(made) / "rows.csv", []
        for name, which in parts:
            head, *lines = (folder / name).read_text().splitlines()
            path.write_text("\n".join([head, *lines[which]]))
            sets.append(load(path, show=False))
    return Trajectories.cat(sets)


def fitted(data: Trajectories) -> Run:
    return fit(data, FitConfig(train_fraction=1.0), progress=False)


def scored(run: Run, test: Trajectories, name: str = "rms", **windows: Any) -> dict[str, Any]:
    found = run.predict(test, **windows)
    return {name: found.rms, f"{name}_failed_steps": found.failed_steps}


def motor_axis(seed: int, folder: Path) -> dict[str, Any]:
    every = slice(seed % AXIS_EVERY, None, AXIS_EVERY)
    data = rows(folder, (MOTOR_AXIS, every))
    train, test = data.split_time(2 / 3)
    return scored(fitted(train), test) | scored(fitted(data), data, "same_part_rms")


def duffing_circuit(seed: int, folder: Path) -> dict[str, Any]:
    first = APART * seed
    train, test = (rows(folder, (DUFFING_CIRCUIT, slice(start, start + PART))) for start in (first, first + PART))
    return scored(fitted(train), test)


def two_joints(seed: int, folder: Path) -> dict[str, Any]:
    data = load(folder / TWO_JOINTS, show=False)
    out = np.random.default_rng(seed).permutation(len(data))[:LEFT_OUT].tolist()
    return scored(fitted(data.select(b for b in range(len(data)) if b not in out)), data.select(out))


def two_motors(seed: int, folder: Path) -> dict[str, Any]:
    every = slice(seed % MOTORS_EVERY, None, MOTORS_EVERY)
    *train, test = ((name, every) for name in TWO_MOTORS)
    run, found = fitted(rows(folder, *train)), {}
    for horizon in HORIZONS:
        found |= scored(run, rows(folder, test), f"rms_{horizon:g}s", windows=WINDOWS, horizon=horizon)
    return found
