"""q and s from 1e-300 to 1e300, mass ratios from 1e-8 to 1e8, angles after a million turns."""

import math

import pytest
import torch
from extreme_cases import assert_nothing_silent, build, starts, state

from herglotz.scenes import scene
from herglotz.stepping import Status, Stepper

EPS = torch.finfo(torch.float64).eps
OSCILLATOR = scene("damped_oscillator")
LINEAR = {
    "exact": OSCILLATOR.L_d,
    "midpoint": OSCILLATOR.L_d_rules["midpoint"],
    "strang": OSCILLATOR.L_d_rules["strang"],
    "model": build(angles=(False,), potential_width=0, rate=0.2),
}


@pytest.mark.parametrize("name", LINEAR)
# Below tiny/ε = 1e-292 Newton's tolerance is absolute: a motion at rest must converge as well.
@pytest.mark.parametrize("size", [1e-290, 1e-200, 1e-160, 1e-100, 1e100, 1e150, 1e153])
def test_a_linear_motion_has_no_scale(name, size):
    # fails if a tolerance or a guess is absolute: the motion from (x q, x p) is x times that from (q, p)
    with torch.no_grad():
        one = Stepper(LINEAR[name]).rollout(*state([1.0], [0.5]), h=0.1, steps=5)
        out = Stepper(LINEAR[name]).rollout(*state([size], [size / 2]), h=0.1, steps=5)
    assert bool(out.ok.all())
    torch.testing.assert_close(out.q / size, one.q, rtol=5 * 64 * EPS, atol=5 * 64 * EPS)
    torch.testing.assert_close(out.p / size, one.p, rtol=5 * 640 * EPS, atol=5 * 640 * EPS)


@pytest.mark.parametrize("name", LINEAR)
def test_the_smallest_motion_is_solved_to_what_is_representable(name):
    # fails if a motion of 1e-300, whose action of 1e-600 is zero, fails, or is wrong by more than 1e-306 over h a step
    with torch.no_grad():
        one = Stepper(LINEAR[name]).rollout(*state([1.0], [0.5]), h=0.1, steps=5)
        out = Stepper(LINEAR[name]).rollout(*state([1e-300], [5e-301]), h=0.1, steps=5)
    assert bool(out.ok.all())
    assert bool((out.s == 0).all())
    assert float((out.q / 1e-300 - one.q).abs().max()) < 2e-5
    assert float((out.p / 1e-300 - one.p).abs().max()) < 2e-4


@pytest.mark.parametrize("name", LINEAR)
@pytest.mark.parametrize("size", [1e155, 1e200, 1e300])
def test_an_action_that_overflows_stops_the_motion_with_a_status(name, size):
    # fails if inf appears in s without a status: s ~ m q²/h is not representable from q ~ 1e154 on
    with torch.no_grad():
        out = Stepper(LINEAR[name]).rollout(*state([size], [size / 2]), h=0.1, steps=3)
    assert out.status[0].tolist() == [Status.DIVERGED] * 3
    assert_nothing_silent(out)


@pytest.mark.parametrize("level", ["conservative", "linear", "forced"])
@pytest.mark.parametrize("s", [1e-300, -1e10, 1e100, 1e300])
def test_any_action_where_it_does_not_enter_the_motion(level, s):
    # fails if s reaches q or p at a level where c is constant, or a large s hides an overflow
    model = build(0.3, level=level)
    with torch.no_grad():
        plain = Stepper(model).rollout(*state([1.0], [0.5]), h=0.1, steps=10)
        out = Stepper(model).rollout(*state([1.0], [0.5], s), h=0.1, steps=10)
    assert bool(out.ok.all())
    assert torch.equal(out.q, plain.q)
    assert torch.equal(out.p, plain.p)
    torch.testing.assert_close(out.s, s * out.sigma + plain.s, rtol=1e-14, atol=0)


@pytest.mark.parametrize("s", [1e-300, 1e3, 1e100, 1e300])
@pytest.mark.parametrize("level", ["affine", "full"])
def test_any_action_where_it_enters_the_motion(level, s):
    # fails if a large s gives a number without a solution behind it
    with torch.no_grad():
        start = starts(10)._replace(s=torch.full((10,), s, dtype=torch.float64))
        out = Stepper(build(0.3, level=level)).rollout(*start, h=0.1, steps=3)
    assert_nothing_silent(out)
    if s < 1:
        assert bool(out.ok.all())
    if s > 1e6:  # damping by s then outweighs the kinetic term by as much: no q1 has this momentum
        assert not bool(out.ok.any())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("explicit", [True, False])
@pytest.mark.parametrize("ratio", [1e-8, 1e-4, 1e4, 1e8])
def test_mass_ratios(ratio, explicit, dtype):
    # fails if a light coordinate is lost beside a heavy one: both oscillate alike, each in its own units
    model = build(dof=2, angles=(False, False), stiffness=(1.0, ratio), potential_width=0)
    with torch.no_grad():
        model.kinetic.log_diagonal.fill_(0.5 * math.log(ratio))
        start = state([1.0, 1.0], [0.5, 0.5 * ratio], dtype=dtype)
        out = Stepper(model.to(dtype), explicit=explicit).rollout(*start, h=0.1, steps=100)
    assert bool(out.ok.all())
    eps = torch.finfo(dtype).eps
    assert float((out.q[..., 0] - out.q[..., 1]).abs().max()) < 100 * eps
    assert float((out.p[..., 0] - out.p[..., 1] / ratio).abs().max()) < 2000 * eps


# A position of 2π · 1e6 has a rounding of 9e-10. The explicit step makes no difference of positions; Newton leaves up
# to 64 ε |q| in q1, which enters p divided by h, at every one of 100 steps.
@pytest.mark.parametrize(("explicit", "bound"), [(True, 100 * 1e-9), (False, 100 * 64 * EPS * 6.3e6 / 0.1)])
def test_a_million_turns(explicit, bound):
    # fails if an angle loses more than the rounding of its own size
    model, turns = build(level="conservative", potential_width=0), 2 * math.pi * 1e6
    with torch.no_grad():
        near, far = (
            Stepper(model, explicit=explicit).rollout(*state([0.3 + x], [0.5]), h=0.1, steps=100) for x in (0.0, turns)
        )
    assert bool(far.ok.all())
    assert float((far.q - turns - near.q).abs().max()) < bound
    assert float((far.p - near.p).abs().max()) < bound
