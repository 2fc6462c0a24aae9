"""A periodic force of known frequency: amplitude and phase learned from positions alone."""

import math

import pytest
import torch

import herglotz as hz
from herglotz.data import Trajectories
from herglotz.scenes import ExactForcedOscillator

F64 = torch.float64
TRUE = ExactForcedOscillator(0.9, 1.7, 0.6, omega0=1.3, gamma=0.4)


def recording(count=200, h=0.1, noise=0.0, seed=0):
    t = h * torch.arange(1, count, dtype=F64)
    q0, p0 = (torch.full((count - 1, 1), x, dtype=F64) for x in (0.7, -0.4))
    q, _, _ = TRUE.flow(q0, p0, torch.zeros(count - 1, dtype=F64), torch.zeros(count - 1, dtype=F64), t)
    q = torch.cat([q.new_tensor([[0.7]]), q])
    q = q + noise * torch.randn(q.shape, generator=torch.Generator().manual_seed(seed), dtype=F64)
    return Trajectories.of(torch.cat([t.new_zeros(1), t]), q)


def force(run):
    """Amplitude and phase of the learned force."""
    a, b = run.model.friction.input_map.detach()[0].tolist()
    return math.hypot(a, b), math.atan2(-b, a)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3, 4))])
def test_amplitude_and_phase_of_a_force_are_learned(tmp_path, seed):
    # fails if sine and cosine are interchanged, the time of a step is another one, or a rollout forgets the waves
    run = hz.fit(
        recording(noise=1e-3, seed=seed), frequencies=1.7, level="forced", objective="trajectory", potential_width=0
    )
    amplitude, phase = force(run)
    assert abs(amplitude - 0.9) < 0.02
    assert abs(phase - 0.6) < 0.02
    assert run.metrics["extrapolation_rms"] < 3e-3  # noise 1e-3
    run.save(tmp_path / "run")
    kept = hz.load_run(tmp_path / "run")
    motion = kept.rollout(60, h=0.1)  # far beyond the data: from the last fitted state on
    start = round(float(motion.t[0]) / 0.1)
    beyond = recording(start + 61).q[start:]
    assert float((torch.from_numpy(motion.q) - beyond).abs().max()) < 0.01
    again = kept.predict(recording(150)).rms
    assert again is not None
    assert again < 0.01
