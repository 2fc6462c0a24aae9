"""The reference flow against an independent 20-digit integrator, and the honesty of its error."""

from functools import cache, partial

import mpmath as mp
import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import damped_pendulum, reference_flow, reference_solve, scene
from herglotz.theory import contact_vector_field

GAMMA = 0.2


@cache
def taylor(q, p, s, dps=20):
    """The damped pendulum by mpmath's Taylor-series integrator: h ↦ (q, p, s); it keeps what it has integrated."""
    with mp.workdps(dps):
        return mp.odefun(
            lambda _, y: [
                y[1],
                -mp.sin(y[0]) - mp.mpf(GAMMA) * y[1],
                y[1] ** 2 / 2 - 1 + mp.cos(y[0]) - mp.mpf(GAMMA) * y[2],
            ],
            0,
            [mp.mpf(q), mp.mpf(p), mp.mpf(s)],
        )


@pytest.mark.parametrize(("h", "tolerance"), [(0.5, 1e-14), (1.0, 3e-14)])
def test_pendulum_against_taylor_series(h, tolerance):
    # fails if the extrapolation weights, the leapfrog start or ṡ is wrong, or convergence is declared too early
    starts = [(0.7, 0.9, 0.3), (-2.3, 1.4, -0.8), (3.1, 0.1, 0.0)]
    q, p, s = torch.tensor(starts, dtype=torch.float64).unbind(-1)
    got = torch.stack([x.flatten() for x in damped_pendulum(GAMMA).flow(q[:, None], p[:, None], s, h)], -1)
    for row, start in zip(got.tolist(), starts, strict=True):
        for value, expected in zip(row, taylor(*start)(h), strict=True):
            assert abs(value - expected) < tolerance


# (q, p, s) from (2.9, 1.4, 0.2) after 6.0, by `taylor` with 30 digits, which takes ten seconds
LATER = (6.5403579527077085, -1.3768704519908863, -0.3995693049000598)


def test_error_estimate_is_honest():
    # fails if the estimate is smaller than the true error when the integration is stopped early
    q, p, s = (torch.tensor(x, dtype=torch.float64) for x in ([[2.9]], [[1.4]], [0.2]))
    H = damped_pendulum(GAMMA).hamiltonian
    for substeps in (2, 4, 8):
        solution = reference_solve(partial(contact_vector_field, H), q, p, s, 6.0, max_substeps=substeps)
        error = max(
            abs(x.item() - y) / (1 + abs(y))
            for x, y in zip((solution.q1, solution.p1, solution.s1), LATER, strict=True)
        )
        assert 1e-14 < error < float(solution.error) < 1e6 * error


def test_unconverged_and_nan_samples_raise():
    # fails if an unconverged or NaN sample is returned silently; the message must say which sample and what to do
    system = damped_pendulum(GAMMA)
    q = torch.tensor([[0.1], [2.0]], dtype=torch.float64)
    H = partial(contact_vector_field, system.hamiltonian)
    h = torch.tensor([0.1, 40.0], dtype=torch.float64)
    with pytest.raises(InputError, match=r"estimated error .* at sample 1 with 4 substeps; use a smaller h"):
        reference_flow(H, q, q, q[:, 0], h, max_substeps=4)
    with pytest.raises(InputError, match=r"estimated error nan .* at sample 0"):
        system.flow(q * torch.nan, q, q[:, 0], 0.1)


def test_sample_does_not_depend_on_its_batch():
    # fails if a hard sample's substeps change an easy one's result
    system = damped_pendulum(GAMMA)
    q = torch.tensor([[0.01], [3.1]], dtype=torch.float64)
    h = torch.tensor([0.05, 9.0], dtype=torch.float64)
    together = system.flow(q, q, q[:, 0], h)
    alone = system.flow(q[:1], q[:1], q[:1, 0], h[:1])
    for a, b in zip(alone, together, strict=True):
        torch.testing.assert_close(a[0], b[0], rtol=0, atol=1e-17)


def test_there_and_back_and_no_step():
    # fails if a negative step is taken as positive, or h = 0 divides by it
    system = damped_pendulum(GAMMA)
    q = torch.tensor([[0.4], [2.0]], dtype=torch.float64)
    there = system.flow(q, q, q[:, 0], 0.8)
    for x, y in zip(system.flow(*there, -0.8), (q, q, q[:, 0]), strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=1e-14)
    for x, y in zip(system.flow(q, q, q[:, 0], 0.0), (q, q, q[:, 0]), strict=True):
        assert torch.equal(x, y)


def test_float32_input_is_integrated_in_float64():
    # fails if single precision is used inside: then the tolerance of 1e-13 could not be met
    system = scene("damped_pendulum")
    q = torch.tensor([[0.4], [2.0]])
    single, double = system.flow(q, q, q[:, 0], 0.5), system.flow(q.double(), q.double(), q[:, 0].double(), 0.5)
    for a, b in zip(single, double, strict=True):
        assert torch.equal(a, b.float())
