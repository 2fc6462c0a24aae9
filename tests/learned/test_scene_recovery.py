"""Scenes that nobody tuned for, fitted with default settings: free runs from unseen starts, in multiples of the noise.

A miss is an `xfail` with the number measured at commit b8a5b875. It is strict: whoever mends the fit removes the mark.
"""

from typing import Any

import pytest

from herglotz.data import simulate
from herglotz.scenes import scene
from herglotz.training import fit

AT_NOISE = 1.5  # as in benchmarks/zoo.py: a perfect model has 1 to 1.3, its start state read from noisy samples
# scene: noise (1 % of the motion), settings of the recording
RECORDINGS: dict[str, tuple[float, dict[str, Any]]] = {
    "duffing": (0.002, {"trajectories": 1, "steps": 399, "h": 0.1, "q_range": (0.4, 0.4), "v_range": (0.0, 0.0)}),
    "driven_duffing": (0.004, {"trajectories": 2, "steps": 200, "h": 0.15}),
    "van_der_pol": (0.014, {"trajectories": 2, "steps": 200, "h": 0.1}),
    "servo_axis": (0.0005, {"trajectories": 1, "steps": 400, "h": 0.02}),
    "cart_pole": (0.005, {"trajectories": 4, "steps": 80, "h": 0.05}),
}
MISS = pytest.mark.xfail(strict=True, reason="unseen starts 1.74 × the noise, held-out time 1.06 ×")


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(x, marks=MISS if x == "cart_pole" else ()) for x in RECORDINGS])
def test_default_settings_reach_the_noise(name):
    # fails if the default settings stop short of what the data hold
    noise, settings = RECORDINGS[name]
    run = fit(simulate(scene(name), noise=noise, seed=0, **settings), progress=False)
    starts = {**settings, "trajectories": 2, "q_range": None, "v_range": None}
    found = run.predict(simulate(scene(name), noise=noise, seed=5, **starts))
    assert found.failed_steps == 0
    assert found.rms is not None
    assert found.rms < AT_NOISE * noise
