"""What the data leave open of free runs beyond them, and that a fit to too short a recording says so."""

import pytest

from herglotz.data import simulate
from herglotz.scenes import scene
from herglotz.training import fit


@pytest.mark.parametrize(("steps", "verdict"), [(40, "does not fit: too little"), (300, "fits to the noise")])
def test_a_recording_that_is_too_short_says_so(steps, verdict):
    # fails if what the data leave open is not looked at (0.4 of a period fits to the noise and tells nothing of the
    # next one), is not carried to longer times, or is asked of terms that a longer recording excludes
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=steps, h=0.06, noise=0.01, seed=2)
    run = fit(data, objective="trajectory", departures=(2e-3,), progress=False)
    assert run.metrics["verdict"].startswith(verdict), run.metrics["verdict"]
