"""The numerically exact L_d: against closed forms, finite differences and its own flow."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import autograd_partials, contact_defect, partials, step_derivative
from herglotz.scenes import NumericallyExact, Reason, exact_discrete_lagrangian, herglotz_motion, scene, scene_names
from herglotz.scenes.exact import lobatto
from herglotz.scenes.reference import constant_rate
from herglotz.stepping import State, Status, Stepper
from tests.compared import f64
from tests.lagrangians import scene_states

NUMERICAL = [scene(name) for name in scene_names() if scene(name).numerical]
BLOCKS = ("L", "D1", "D2", "D3", "D11", "D12", "D22", "D13", "D23", "D33")


def numerical(system):
    assert isinstance(system.numerical, NumericallyExact)
    return system.numerical


def assert_same(P, A, atol):
    for name in BLOCKS:
        torch.testing.assert_close(getattr(P, name), getattr(A, name), rtol=0, atol=atol, msg=lambda m, n=name: n + m)


@pytest.mark.parametrize("name", ["damped_oscillator", "quadratic_drag"])
def test_closed_forms(name):
    # fails if any of the ten formulas in the sensitivities is wrong, if v is not turned into p = L_v (which depends on
    # s for the drag), or if a constant c hides its gradient (c = e^{2λΔ} there)
    system = scene(name, **scene(name).examples[0])
    q, p, s = scene_states(system, 2)
    h = f64(0.3, 0.8)
    q1 = system.flow(q, p, s, h)[0] + 0.05
    P = partials(exact_discrete_lagrangian(system.lagrangian), q, q1, s, h, 2)
    assert_same(P, partials(system.L_d, q, q1, s, h, 2), atol=2e-11 if name == "quadratic_drag" else 1e-13)


@pytest.mark.parametrize("system", NUMERICAL, ids=lambda s: s.name)
def test_it_generates_the_flow(system):
    # fails if FL⁻ or FL⁺ is not that of the motion, or if the step it generates is no contact map (D12, D13, D23, D33
    # all enter its derivative); and with a c that is off by 1e-6 the check must see it
    q, p, s = scene_states(system, 2, seed=1)
    q1, p1, s1 = system.flow(q, p, s, system.h)
    P = partials(numerical(system), q, q1, s, system.h, 2)
    torch.testing.assert_close(-P.D1 / P.c[:, None], p, rtol=0, atol=2e-11)
    torch.testing.assert_close(P.D2, p1, rtol=0, atol=2e-11)
    torch.testing.assert_close(s + P.L, s1, rtol=0, atol=1e-12)
    D = step_derivative(P, p)
    size = float(D.abs().max() * p1.abs().max().clamp_min(1.0))
    assert float(contact_defect(D, p, p1, P.c).abs().max()) < 1e-11 * size
    assert float(contact_defect(D, p, p1, P.c * (1 + 1e-6)).abs().max()) > 1e-7


def test_second_partials_are_differences_of_first():
    # fails if D33, which the contact condition leaves free, or any other block is wrong where L is nonlinear in s
    system = scene("nonlinear_action", damping=1.5)
    L_d, h, e = numerical(system), f64(0.4)[0], 1e-4
    q0, q1, s0 = f64(0.3, -0.5), f64(0.5, -0.3), f64(0.4)[0]
    P = partials(L_d, q0, q1, s0, h, 2)
    shift = torch.cat([torch.zeros(1, 5), torch.eye(5), -torch.eye(5)]).double() * e
    x = torch.cat([q0, q1, s0[None]]) + shift
    R = partials(L_d, x[:, :2], x[:, 2:4], x[:, 4], h)
    first = torch.cat([R.D1, R.D2, R.D3[:, None]], -1)
    H = (first[1:6] - first[6:]) / (2 * e)
    torch.testing.assert_close(H, H.mT, rtol=0, atol=1e-7)
    blocks = torch.cat(
        [
            torch.cat([P.D11, P.D12, P.D13[:, None]], -1),
            torch.cat([P.D12.mT, P.D22, P.D23[:, None]], -1),
            torch.cat([P.D13, P.D23, P.D33[None]])[None],
        ]
    )
    torch.testing.assert_close(H, blocks, rtol=0, atol=1e-7)
    assert float(P.D33.abs()) > 1e-3
    assert float((R.L[1:6] - R.L[6:]).sub(2 * e * first[0]).abs().max()) < 1e-11


def test_autograd_sees_the_same_derivatives():
    # fails if the Taylor polynomials that carry the graph miss a factor ½ or a block
    system = scene("damped_pendulum")
    q, s, h = f64(0.4, -1.0)[:, None], f64(0.2, -0.1), f64(0.3)[0]
    P = partials(numerical(system), q, q + 0.2, s, h, 2)
    assert_same(autograd_partials(numerical(system).__call__, q, q + 0.2, s, h, 2), P, atol=1e-14)
    q1 = (q + 0.2).requires_grad_()
    (slope,) = torch.autograd.grad(partials(numerical(system), q, q1, s, h).D1.sum(), q1)
    torch.testing.assert_close(slope, P.D12[..., 0])
    second = partials(numerical(system), q, q1, s, h, 2).D12
    # fails if a third derivative is silently zero
    with pytest.raises(InputError, match="third derivatives of the numerically exact L_d are not available"):
        torch.autograd.grad(second.sum(), q1)
    with pytest.raises(InputError, match="no derivative with respect to h"):
        partials(numerical(system), q, q1, s, h.clone().requires_grad_())


def test_beyond_a_conjugate_point_is_nan_with_a_reason():
    # fails if a motion past a conjugate point (a wrong branch of L_d) is returned: for the oscillator that is h > π/ω,
    # also past the second one; in the plane det ∂q/∂p = (sin ωh/ω)² never changes its sign
    system = scene("damped_oscillator")
    L_d = exact_discrete_lagrangian(system.lagrangian)
    q = torch.zeros(4, 2, dtype=torch.float64) + 0.5
    h = f64(3.0, 3.3, 6.0, 7.0)  # π/ω = 3.157, 2π/ω = 6.315
    shot = L_d.shoot(q, q + 0.3, torch.zeros(4).double(), h)
    assert shot.reason.tolist() == [Reason.NONE, Reason.CONJUGATE, Reason.CONJUGATE, Reason.CONJUGATE]
    assert shot.P.L.isnan().tolist() == shot.P.D12.isnan()[:, 0, 0].tolist() == [False, True, True, True]
    assert shot.P.D1.isnan()[:, 0].tolist() == [False, True, True, True]
    torch.testing.assert_close(shot.P.L[0], system.L_d(q, q + 0.3, f64(0.0), h)[0])


def test_rest_is_judged_within_the_pieces():
    # fails if only the joints between pieces are judged: few nodes resolve rest, and at h = 28 each of four pieces is
    # past conjugate points of its own, while the joints look like minima
    L_d = exact_discrete_lagrangian(scene("damped_oscillator").lagrangian)
    rest = torch.zeros(2, 1, dtype=torch.float64)
    assert L_d.shoot(rest, rest, rest[:, 0], f64(3.0, 28.0)).reason.tolist() == [Reason.NONE, Reason.CONJUGATE]


@pytest.mark.parametrize("count", [3, 5, 8, 9])
def test_polynomials_through_lobattos_nodes(count):
    # fails if a weight or the norm of a Legendre polynomial is wrong: degree k − 1 is integrated exactly to every node
    nodes, integral, finer = lobatto(count)
    for m in range(count):
        torch.testing.assert_close(integral @ nodes**m, nodes ** (m + 1) / (m + 1), rtol=0, atol=1e-15)
        if len(finer):
            torch.testing.assert_close(finer @ nodes**m, lobatto(2 * count - 1)[0] ** m, rtol=0, atol=3e-15)
    assert len(finer) == (2 * count - 1 if count % 2 else 0)


def test_a_turning_motion_has_its_conjugate_point_where_it_is():
    # fails if complex eigenvalues of ∂q/∂p0 judge: v²/2 + ¾(q₁v₂ − q₂v₁) − q²/2 turns by 0.75 t, so that they leave the
    # right half-plane at t = 2.09 and are back in it beyond the first conjugate point, π/1.25 = 2.513
    def A(q):
        return 0.75 * torch.stack([-q[..., 1], q[..., 0]], -1)

    motion = herglotz_motion(
        lambda q, v, s: 0.5 * (v * v).sum(-1) + (A(q) * v).sum(-1) - 0.5 * (q * q).sum(-1) + 0 * s,
        lambda q, v, s: v + A(q) + 0 * s[..., None],
        lambda q, p, s: p - A(q) + 0 * s[..., None],
        lambda q, v, s: -A(v) - q + 0 * s[..., None],
        constant_rate(0.0),
    )
    q, h = torch.zeros(4, 2).double() + 0.5, f64(2.2, 2.45, 2.6, 4.0)
    shot = exact_discrete_lagrangian(motion).shoot(q, q + 0.3, torch.zeros(4).double(), h)
    assert shot.reason.tolist() == [Reason.NONE, Reason.NONE, Reason.CONJUGATE, Reason.CONJUGATE]
    # in the frame that turns with it, the motion is an oscillator of frequency 1.25
    w, z0, z1 = 1.25, torch.complex(f64(0.5), f64(0.5)), torch.complex(f64(0.8), f64(0.8))
    z1 = z1 * torch.polar(torch.ones_like(h), 0.75 * h)
    L = w / (2 * torch.sin(w * h)) * ((0.5 + 1.28) * torch.cos(w * h) - 2 * (z0.conj() * z1).real)
    torch.testing.assert_close(shot.P.L[:2], L[:2], rtol=1e-11, atol=0)


def test_other_failures_have_their_reason():
    # fails if an unresolved flow, or a shooting that ran out of iterations, is returned as if it were exact
    system = scene("damped_pendulum")
    motion = numerical(system).motion
    q, s = f64(0.4)[:, None], f64(0.2)
    coarse = exact_discrete_lagrangian(motion, max_nodes=9)
    assert coarse.shoot(q, q + 0.2, s, 2.0).reason.tolist() == [Reason.UNRESOLVED]
    hasty = exact_discrete_lagrangian(motion, max_iterations=1)
    assert hasty.shoot(q, q + 0.5, s, 1.0).reason.tolist() == [Reason.NOT_CONVERGED]
    assert bool(hasty(q, q + 0.5, s, f64(1.0)[0]).isnan().all())


def test_samples_do_not_meet_and_float32_comes_back():
    # fails if a failed neighbour stops or changes a sample, or single precision is used inside
    L_d = numerical(scene("damped_pendulum"))
    q, s, h = f64(0.4, torch.nan, -1.0)[:, None], f64(0.2, 0.0, -0.1), f64(0.5)[0]
    together, alone = L_d(q, q + 0.2, s, h), L_d(q[2], q[2] + 0.2, s[2], h)
    assert together.isnan().tolist() == [False, True, False]
    assert abs(together[2] - alone) < 1e-13
    single = partials(L_d, q[2].float(), q[2].float() + 0.2, s[2].float(), 0.5, 2)
    assert single.D12.dtype == torch.float32
    assert abs(single.L.double() - alone) < 1e-6


def test_a_step_of_a_users_lagrangian_evaluates_it_a_few_times():
    # fails if the motion is integrated again for each trial (shooting called L 8100 times a step), or L is called for
    # each node: counted, a step calls L 30 times at h = 0.1 and 42 times at h = 0.3
    calls = []

    def L(q, v, s):
        calls.append(q.shape)
        return 0.5 * (v * v).sum(-1) + 0.1 * v[..., 0] * v[..., 1] * q[..., 0].cos() + q.cos().sum(-1) - 0.1 * s.sin()

    stepper, start = Stepper(exact_discrete_lagrangian(L)), State(f64(0.3, -0.2), f64(0.4, 0.1), f64(0.1)[0])
    step = stepper.step(start, 0.1)
    assert int(step.status) == Status.CONVERGED
    assert len(calls) < 80
