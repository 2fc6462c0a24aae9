"""The Hopf–Lax form, its Riccati recursion and its caustics (E7)."""

import pytest
import torch

from herglotz.mechanics import partials
from herglotz.scenes import scene
from herglotz.stepping import Status, StepError
from herglotz.theory import PointSource, Propagated, Quadratic, germ, hopf_lax, riccati_step
from tests.lagrangians import bowl, nonlinear

OSCILLATOR = scene("damped_oscillator")
GOLDEN = (-0.26006580555808590321, 0.30739377267571633841, 0.1460659481608371959)


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


def blocks(h=0.1):
    return partials(OSCILLATOR.L_d, tensor([0.0]), tensor([0.0]), tensor(0.0), h, order=2)


def start():
    return Quadratic(tensor([[1.0]]), tensor([0.5]), tensor(0.25))


def quadratic_through(out, y):
    """The quadratic with these derivatives at y."""
    beta = out.dS - (out.d2S @ y[..., None])[..., 0]
    delta = out.S - 0.5 * (y * (out.d2S @ y[..., None])[..., 0]).sum(-1) - (beta * y).sum(-1)
    return Quadratic(out.d2S, beta, delta)


def assert_golden(S):
    for value, number in zip((S.alpha, S.beta, S.delta), GOLDEN, strict=True):
        assert abs(value.item() - number) <= 1e-12 * abs(number)


def test_riccati_by_the_formula():
    # fails if α′, β′ or δ′ has a wrong sign or power of c
    S = start()
    for _ in range(10):
        S = riccati_step(blocks(), S)
    assert_golden(S)


@pytest.mark.parametrize("h", [0.1, [0.1] * 10])
def test_riccati_by_one_curve(h):
    # fails if ten extremals sought together differ from ten sought in turn
    y = tensor([-1.3])
    out = hopf_lax(OSCILLATOR.L_d, start(), y, h=h, steps=10)
    assert out.curve.q.shape == (11, 1)
    assert_golden(quadratic_through(out, y))


def test_riccati_of_two_coupled_coordinates():
    # fails if B is not transposed on the left: B is not symmetric here
    make = torch.Generator().manual_seed(0)
    A, B, C = (torch.randn(2, 2, generator=make, dtype=torch.float64) for _ in range(3))
    A, C = A @ A.mT + 2 * torch.eye(2), C @ C.mT

    def L_d(q0, q1, s0, h):
        quadratic = 0.5 * ((q0 @ A) * q0).sum(-1) + ((q0 @ B) * q1).sum(-1) + 0.5 * ((q1 @ C) * q1).sum(-1)
        return -0.1 * s0 + quadratic + 0 * h

    S = Quadratic(torch.eye(2, dtype=torch.float64), tensor([0.5, -0.2]), tensor(0.25))
    y = tensor([0.3, -0.4])
    zero = torch.zeros(2, dtype=torch.float64)
    formula = riccati_step(partials(L_d, zero, zero, tensor(0.0), 1.0, order=2), S)
    found = quadratic_through(hopf_lax(L_d, S, y, h=1.0, beyond=True), y)
    for key in ("alpha", "beta", "delta"):
        torch.testing.assert_close(getattr(found, key), getattr(formula, key), rtol=1e-12, atol=1e-12)


def test_derivatives_are_those_of_the_value():
    # fails if dS or d2S does not belong to S, for a nonlinear L_d and S; central differences of S alone
    y, eps = tensor([[0.2, -0.4], [0.5, 0.1]]), 1e-4
    out = hopf_lax(nonlinear, bowl, y, h=0.2, steps=4)
    assert out.status.tolist() == [Status.CONVERGED] * 2
    for i in range(2):
        d = eps * torch.eye(2, dtype=torch.float64)[i]
        up, down = (hopf_lax(nonlinear, bowl, x, h=0.2, steps=4) for x in (y + d, y - d))
        torch.testing.assert_close((up.S - down.S) / (2 * eps), out.dS[:, i], rtol=0, atol=1e-8)
        torch.testing.assert_close((up.dS - down.dS) / (2 * eps), out.d2S[:, i], rtol=0, atol=1e-7)


def test_one_curve_is_two_hopf_lax_steps():
    # fails if S^{k+2} through one curve is not S^{k+1} propagated once more
    y = tensor([[0.2, -0.4], [0.5, 0.1]])
    once = hopf_lax(nonlinear, bowl, y, h=0.2, steps=2)
    twice = hopf_lax(nonlinear, Propagated(nonlinear, bowl, 0.2), y, h=0.2)
    torch.testing.assert_close((once.S, once.dS, once.d2S), (twice.S, twice.dS, twice.d2S), rtol=1e-11, atol=1e-11)
    at = germ(Propagated(nonlinear, bowl, 0.2, steps=2), y)
    torch.testing.assert_close((at.S, at.dS), (once.S, once.dS))


def test_from_a_point_source_the_exact_action_comes_out():
    # fails if S¹ is not L_d (E7: S⁰ is no function), or S^k is not L_d with h → kh; closed form at any k
    q, s, y = tensor([1.0]), tensor(0.3), tensor([[0.2], [0.9], [1.7]])
    for k in (2, 5, 12):
        out = hopf_lax(OSCILLATOR.L_d, PointSource(OSCILLATOR.L_d, q, s, 0.1), y, h=0.1, steps=k - 1)
        P = partials(OSCILLATOR.L_d, q.expand(3, 1), y, s.expand(3), 0.1 * k, order=2)
        for value, expected in ((out.S, s + P.L), (out.dS, P.D2), (out.d2S, P.D22)):
            torch.testing.assert_close(value, expected, rtol=1e-11, atol=1e-11)


def test_the_caustic_is_reported_at_its_exact_place():
    # fails if A + cα = 0 gives a number, or a regular neighbour in the batch is lost
    P = blocks()
    critical = -P.D11 / P.c
    alpha = torch.stack([critical, 0.9 * critical, tensor([[1.0]])])
    S = Quadratic(alpha, tensor([0.5]).expand(3, 1), tensor(0.25).expand(3))
    out = hopf_lax(OSCILLATOR.L_d, S, tensor([0.7]).expand(3, 1), h=0.1)
    assert out.status.tolist() == [Status.SINGULAR, Status.CONVERGED, Status.CONVERGED]
    assert out.S.isnan().tolist() == [True, False, False]
    assert float(out.curve.opening.final[0]) < 1e-14
    assert "caustic" in out.curve.failures()[0]
    assert not bool(torch.isfinite(riccati_step(P, Quadratic(critical, S.beta[0], S.delta[0])).alpha).all())
    with pytest.raises(StepError, match="SINGULAR: caustic"):
        hopf_lax(OSCILLATOR.L_d, S, tensor([0.7]).expand(3, 1), h=0.1, throw=True)


def test_a_caustic_between_two_steps_is_not_stepped_over():
    # fails if S is continued past its caustic without a word: α = −2 focuses after about 0.5, between two steps
    S = Quadratic(tensor([[-2.0]]), tensor([0.1]), tensor(0.0))
    y = tensor([0.3])
    assert int(hopf_lax(OSCILLATOR.L_d, S, y, h=0.1, steps=4).status) == Status.CONVERGED
    out = hopf_lax(OSCILLATOR.L_d, S, y, h=0.1, steps=8)
    assert int(out.status) == Status.SINGULAR
    assert bool(out.S.isnan())
    (line,) = out.curve.failures()
    alpha, step = S, None
    for k in range(8):  # where the recursion's pivot A + cα changes sign
        P = blocks()
        if step is None and float(P.D11 + P.c * alpha.alpha) < 0:
            step = k
        alpha = riccati_step(P, alpha)
    assert line.endswith(f"caustic crossed in step {step}")
    beyond = hopf_lax(OSCILLATOR.L_d, S, y, h=0.1, steps=8, beyond=True)
    torch.testing.assert_close(beyond.S, alpha(y), rtol=1e-11, atol=1e-12)


def larmor(q0, q1, s0, h):
    """v²/2 + ¾(q₁v₂ − q₂v₁) − q²/2 by the midpoint rule: rotation at 0.75, caustics at multiples of π/1.25."""
    v, m = (q1 - q0) / h[..., None], 0.5 * (q0 + q1)
    turn = m[..., 0] * v[..., 1] - m[..., 1] * v[..., 0]
    return h * (0.5 * (v * v).sum(-1) + 0.75 * turn - 0.5 * (m * m).sum(-1)) + 0 * s0


def test_a_double_caustic_of_a_turning_family_is_seen():
    # fails if complex eigenvalues of ∂q_{k+1}/∂q_k are taken for no caustic: from S = β·q all n directions focus
    # together at t = π/2.5 = 1.257, and the gyroscopic term has turned them by 54° there
    S = Quadratic(torch.zeros(2, 2).double(), tensor([0.1, 0.2]), tensor(0.0))
    before, after = (hopf_lax(larmor, S, tensor([0.3, 0.4]), h=0.1, steps=N) for N in (12, 13))
    assert int(before.status) == Status.CONVERGED
    assert int(after.status) == Status.SINGULAR
    assert int(after.curve.opening.crossed) == 12
    again = hopf_lax(larmor, S, tensor([0.3, 0.4]), h=0.1, steps=40, beyond=True)  # past the next one at 3π/2.5 = 3.77
    assert int(again.curve.opening.crossed) == 12  # the first
    # a point source opens a step later than it starts, and focuses at π/1.25 = 2.513 (midpoint rule: 2.52)
    source = PointSource(larmor, tensor([0.3, 0.4]), tensor(0.0), 0.1)
    before, after = (hopf_lax(larmor, source, tensor([0.3, 0.5]), h=0.1, steps=N) for N in (24, 25))
    assert (int(before.status), int(after.status)) == (Status.CONVERGED, Status.SINGULAR)


def test_a_step_of_more_than_half_a_turn_of_a_charge_is_no_caustic():
    # fails if −D12, which the field has turned by Bh/2 > π/2, is taken for a negative kinetic term: the exact L_d of a
    # free charge, B = 1, valid to h = 2π; a family with dS = q focuses at tan(h/2) = −1/2, h = 5.36
    def charge(q0, q1, s0, h):
        d = q1 - q0
        area = q0[..., 0] * q1[..., 1] - q0[..., 1] * q1[..., 0]
        return (d * d).sum(-1) / (4 * torch.tan(h / 2)) + 0.5 * area + 0 * s0

    S = Quadratic(torch.eye(2).double(), tensor([0.0, 0.0]), tensor(0.0))
    for h in (1.0, 3.0, 3.5, 4.5):
        assert int(hopf_lax(charge, S, tensor([0.3, 0.4]), h=h).status) == Status.CONVERGED


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_sign_of_the_kinetic_term_is_not_a_caustic(sign):
    # fails if a negative mass counts as a caustic: −L_d has the same motions, and its S is −S
    S = Quadratic(tensor([[0.4]]) * sign, tensor([0.1]), tensor(0.0))

    def L_d(q0, q1, s0, h):
        return sign * OSCILLATOR.L_d(q0, q1, sign * s0, h)

    out = hopf_lax(L_d, S, tensor([0.3]), h=0.1, steps=5)
    assert int(out.status) == Status.CONVERGED
    assert int(hopf_lax(L_d, S, tensor([0.3]), h=0.1, steps=30).status) == Status.SINGULAR
