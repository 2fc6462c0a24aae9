"""The fixed-lag smoother: the exact conditional mean and covariance of a linear motion, and errors that it lowers."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.stepping.filter import KalmanFilter, Noise

H, STEPS, LAG = 0.3, 9, 4
NOISE = Noise([0.05], [0.4])
STD = torch.tensor([0.3, 0.5], dtype=torch.float64)


@pytest.fixture(scope="module")
def spring():
    """A damped spring: its step is linear, so that a Kalman filter is exact."""
    config = ModelConfig((False,), "linear", (1.0,), (1.0,), (4.0,), (0.0,), rate=0.3, potential_width=0)
    return KalmanFilter(ContactLagrangian(config).requires_grad_(False), NOISE)


def begun(kalman):
    zero = torch.zeros(1, dtype=torch.float64)
    return kalman.start(State(zero, zero, zero[0]), STD)


def readings():
    return torch.randn(STEPS, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def conditional(kalman, rows):
    """Mean (STEPS + 1, 2) and covariance of q, p at all times, given the readings at these times: one big Gaussian."""
    begin = begun(kalman)
    A = Stepper(kalman.model).linearise(begin.state, H).by_state[:2, :2]
    half = torch.diag(torch.tensor([0.0, NOISE.momentum[0] ** 2 * H / 2], dtype=torch.float64))
    added = A @ half @ A.T + half
    size = 2 * (STEPS + 1)
    # x_k = Σ_j A^(k−j) w_j with independent w_j
    root = torch.zeros(size, size, dtype=torch.float64)
    for k in range(STEPS + 1):
        for j in range(k + 1):
            root[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = torch.linalg.matrix_power(A, k - j)
    C = root @ torch.block_diag(torch.diag(STD**2), *[added] * STEPS) @ root.T
    H_y = torch.zeros(len(rows), size, dtype=torch.float64)
    for i, k in enumerate(rows):
        H_y[i, 2 * (k + 1)] = 1.0
    gain = torch.linalg.solve(H_y @ C @ H_y.T + NOISE.position[0] ** 2 * torch.eye(len(rows)).double(), H_y @ C).T
    y = readings()[list(rows), 0]
    return (gain @ y).reshape(-1, 2), C - gain @ H_y @ C


def test_it_is_the_conditional_of_a_linear_motion(spring):
    # fails if an earlier sample is moved by another covariance, noise of forces enters an earlier sample, or a sample
    # is missing or counted twice: mean and covariance are those of a single Gaussian of all times
    belief = begun(spring)
    for k, y in enumerate(readings()):
        belief, _ = spring.update(spring.predict(spring.remember(belief, LAG), H), y)
        mean, C = conditional(spring, range(k + 1))
        for back in range(min(LAG, k + 1) + 1):
            at, place = spring.smoothed(belief, back), k + 1 - back
            x = torch.cat([at.state.q, at.state.p])
            own = slice(2 * place, 2 * place + 2)
            torch.testing.assert_close(x, mean[place], rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(at.covariance, C[own, own], rtol=1e-9, atol=1e-12)
    with pytest.raises(InputError, match=f"back must be 0 to {LAG}"):
        spring.smoothed(belief, LAG + 1)
