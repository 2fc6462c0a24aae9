"""The one door to derivatives, Legendre transforms, M and the discrete Hamiltonians."""

import pytest
import torch

from herglotz.mechanics import (
    autograd_partials,
    herglotz_residual,
    mixed_hessian,
    momentum_jacobian,
    partials,
    step_derivative,
)
from herglotz.mechanics.contact import flow_derivative
from herglotz.scenes import scene
from herglotz.stepping import State, Stepper


def polynomial(q0, q1, s0, h):
    """Every second derivative is different and known."""
    return (q0 * q0 * q1).sum(-1) + 2 * (q0 * q1 * q1).sum(-1) + s0 * (q0.sum(-1) - 3 * q1.sum(-1)) + s0 * s0 * h


def points(n=2, batch=5, seed=0):
    make = torch.Generator().manual_seed(seed)
    q0, q1 = torch.randn(2, batch, n, generator=make, dtype=torch.float64)
    return q0, q1, torch.randn(batch, generator=make, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)


def test_autograd_matches_hand_derivatives():
    # fails if any block is transposed, swapped or differentiated with respect to the wrong argument
    q0, q1, s0, h = points()
    P = partials(polynomial, q0, q1, s0, h, order=2)
    torch.testing.assert_close(P.D1, 2 * q0 * q1 + 2 * q1**2 + s0[:, None])
    torch.testing.assert_close(P.D2, q0**2 + 4 * q0 * q1 - 3 * s0[:, None])
    torch.testing.assert_close(P.D3, q0.sum(-1) - 3 * q1.sum(-1) + 2 * s0 * h)
    torch.testing.assert_close(P.D11, torch.diag_embed(2 * q1))
    torch.testing.assert_close(P.D12, torch.diag_embed(2 * q0 + 4 * q1))
    torch.testing.assert_close(P.D22, torch.diag_embed(4 * q0))
    torch.testing.assert_close(P.D13, torch.ones_like(q0))
    torch.testing.assert_close(P.D23, -3 * torch.ones_like(q0))
    torch.testing.assert_close(P.D33, 2 * h.expand(5))


def test_d12_is_not_symmetrised():
    # fails if D12 is stored as ∂²L/∂q1∂q0
    A = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    q0, q1, s0, h = points()
    P = partials(lambda q0, q1, s0, h: torch.einsum("...i,ij,...j->...", q0, A, q1) + 0 * s0 * h, q0, q1, s0, h, 2)
    torch.testing.assert_close(P.D12, A.expand(5, 2, 2))


def test_same_tensor_twice():
    # fails if q0 and q1 share an autograd leaf when a caller passes one tensor for both
    q0, _, s0, h = points()
    P = partials(polynomial, q0, q0, s0, h)
    torch.testing.assert_close(P.D1, 4 * q0**2 + s0[:, None])


def test_order_is_checked():
    # fails if order 3 silently returns order 2
    with pytest.raises(ValueError, match="order must be 1 or 2, got 3"):
        partials(polynomial, *points(), order=3)


def test_no_graph_where_nothing_wants_one():
    # fails if a rollout of an analytic scene drags an autograd graph along
    P = partials(polynomial, *points(), order=2)
    assert not P.L.requires_grad
    assert not P.D12.requires_grad


def test_graph_where_a_parameter_wants_one():
    # fails if derivatives with respect to a parameter inside a closure are cut off
    a = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    q0, q1, s0, h = points()
    P = partials(lambda q0, q1, s0, h: a * polynomial(q0, q1, s0, h), q0, q1, s0, h)
    (gradient,) = torch.autograd.grad(P.D1.sum(), a)
    torch.testing.assert_close(gradient, (2 * q0 * q1 + 2 * q1**2 + s0[:, None]).sum())


def test_herglotz_residual_vanishes_along_a_flow_and_only_there():
    # fails if the residual uses s_k where s_{k−1} belongs (erratum E3)
    oscillator = scene("damped_oscillator", gamma=0.7)
    q = torch.tensor([[1.0], [-0.4]], dtype=torch.float64)
    p, s = torch.tensor([[0.5], [2.0]], dtype=torch.float64), torch.tensor([0.3, -1.0], dtype=torch.float64)
    q1, p1, s1 = oscillator.flow(q, p, s, 0.3)
    q2, _, _ = oscillator.flow(q1, p1, s1, 0.4)
    R = herglotz_residual(oscillator.L_d, q, q1, q2, s, 0.3, 0.4)
    assert float(R.abs().max()) < 1e-13
    assert float(herglotz_residual(oscillator.L_d, q, q1, q2 + 0.01, s, 0.3, 0.4).abs().min()) > 1e-3


@pytest.mark.parametrize(("c2", "c3", "expected"), [(1.0, 0.0, 0.0), (0.0, 1.0, 1.0)])
def test_regularity_is_decided_by_m_not_by_d22(c2, c3, expected):
    # fails if regularity is read off D2D2 (erratum E4): (q0²+q1²)/2 has D22 = 1, M = 0; q0 q1 has D22 = 0, M = 1
    q0, q1, s0, h = points(n=1)
    L = lambda q0, q1, s0, h: (c2 * (q0**2 + q1**2) / 2 + c3 * q0 * q1).sum(-1) + 0 * s0 * h  # noqa: E731
    M = mixed_hessian(partials(L, q0, q1, s0, h, 2))
    torch.testing.assert_close(M, torch.full((5, 1, 1), expected, dtype=torch.float64))


def test_m_is_the_momentum_jacobian_on_the_solution():
    # fails if the sign of D1 ⊗ D3D2 in M is wrong
    q0, q1, s0, h = points()
    P = partials(polynomial, q0, q1, s0, h, 2)
    p0 = -P.D1 / P.c[:, None]
    torch.testing.assert_close(mixed_hessian(P), momentum_jacobian(P, p0))
    expected = P.D12 - P.D1[:, :, None] * P.D23[:, None, :] / P.c[:, None, None]
    torch.testing.assert_close(mixed_hessian(P), expected)


def test_step_derivative_is_the_derivative_of_the_step():
    # fails if a term of the implicit-function theorem is missing, for an L_d that is nonlinear in s
    def L_d(q0, q1, s0, h):
        v, m = (q1 - q0) / h, (q0 + q1) / 2
        twist = q0[..., 0] * torch.sin(q1[..., 1])  # so that D1D2 is not symmetric
        return h * ((v**2).sum(-1) / 2 - torch.cos(m).sum(-1) - 0.3 * torch.sin(s0) * (1 + 0.2 * m.sum(-1)) + twist)

    q, p, s, _ = points(seed=3)
    flow = lambda q, p, s: Stepper(L_d).step(State(q, p, s), 0.2).state  # noqa: E731
    (q1, _, _), D = flow_derivative(flow, q, p, s)
    closed = step_derivative(autograd_partials(L_d, q, q1, s, 0.2, 2), p)
    torch.testing.assert_close(closed, D, rtol=1e-11, atol=1e-12)
    e = 1e-6  # and both are the derivative of the map itself
    plus, minus = flow(q + e, p, s), flow(q - e, p, s)
    torch.testing.assert_close(D[:, :2, :2].sum(-1), (plus[0] - minus[0]) / (2 * e), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_the_derivative_of_a_flow_under_any_axes(batch):
    # fails if q, p and s are joined along another axis than the last
    make = torch.Generator().manual_seed(0)
    q, p = torch.randn(2, *batch, 2, dtype=torch.float64, generator=make)
    s = torch.randn(batch, dtype=torch.float64, generator=make)
    _, D = flow_derivative(lambda q, p, s: (q + 2 * p, 3 * p, s + 5 * q.sum(-1)), q, p, s)
    known = [[1, 0, 2, 0, 0], [0, 1, 0, 2, 0], [0, 0, 3, 0, 0], [0, 0, 0, 3, 0], [5, 5, 0, 0, 1]]
    assert torch.equal(D, torch.tensor(known, dtype=torch.float64).expand(*batch, 5, 5))
