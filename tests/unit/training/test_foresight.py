"""What the data leave open of free runs beyond them, and that a fit to too short a recording says so."""

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from herglotz.training import fit
from herglotz.training.foresight import _Ahead


@pytest.mark.parametrize(("steps", "verdict"), [(40, "does not fit: too little"), (300, "fits to the noise")])
def test_a_recording_that_is_too_short_says_so(steps, verdict):
    # fails if what the data leave open is not looked at (0.4 of a period fits to the noise and tells nothing of the
    # next one), is not carried to longer times, or is asked of terms that a longer recording excludes
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=steps, h=0.06, noise=0.01, seed=2)
    run = fit(data, objective="trajectory", departures=(2e-3,), progress=False)
    assert run.metrics["verdict"].startswith(verdict), run.metrics["verdict"]


def test_runs_that_go_on_by_one_sample_are_followed():
    # fails if a run of two samples, the last known one and the next, is taken for a trajectory: the fit then ended with
    # "trajectory 0 has 2 samples, at least 3 are needed" (27 samples at h = 1)
    model = ContactLagrangian(ModelConfig((True,), "linear", (1.0,), (1.0,), (1.0,), (0.0,), potential_width=0))
    t = 0.1 * torch.arange(5, dtype=torch.float64)
    made = Trajectories.of(t, 0 * t, angles=(True,))
    runs = _Ahead(made, torch.tensor([0, 1, 2, 3, -1]), [0], t > 0.15, 0.3)
    with torch.no_grad():
        out = Stepper(model).rollout(*torch.tensor([[0.5], [0.1]], dtype=torch.float64), h=0.1, steps=4)
    states = torch.cat([out.q, out.p, out.s[:, None]], -1)
    found = runs.stepped_on(model, states[:4], 0.1)
    assert found is not None
    torch.testing.assert_close(found, states)
