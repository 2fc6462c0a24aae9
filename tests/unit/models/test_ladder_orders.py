"""Order 2 at every new level, measured as a slope with irregular steps on nonlinear damped problems."""

import math
from typing import Any

import pytest
import torch

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.action import unit_increment
from herglotz.models.jet import Jet
from herglotz.models.terms import Phase
from herglotz.scenes import scene
from herglotz.stepping import State, Stepper
from tests.lagrangians import randomise


def build(config) -> Any:
    """The model; which of its terms are there is what the tests know and types do not."""
    return ContactLagrangian(config)


def end(model, steps, h_total=2.0, s=0.3):
    """(q, p, s) at t = h_total with steps 1 : 2 : 2 : 1, the same backwards, so that odd error terms cancel."""
    n = model.dof
    q, p = torch.linspace(1.2, 0.6, n).double()[None], torch.linspace(0.7, -0.4, n).double()[None]
    h = torch.tensor([1.0, 2.0, 2.0, 1.0], dtype=torch.float64).repeat(steps // 4)
    with torch.no_grad():
        out = Stepper(model).rollout(q, p, torch.tensor([s], dtype=torch.float64), h=h * h_total / h.sum())
    assert bool(out.ok.all())
    return torch.cat([out.final.q[0], out.final.p[0], out.final.s])


def slopes(model, exact, steps=40):
    coarse, fine = ((end(model, k) - exact).abs() for k in (steps, 2 * steps))
    return torch.log2(coarse / fine).tolist()


def test_conservative_level_is_second_order():
    # fails if half of V is lost at an end, or K is not V's partner
    model = build(ModelConfig(level="conservative", potential_width=0))
    q, p, s, t = (torch.tensor(x, dtype=torch.float64) for x in ([[1.2]], [[0.7]], [0.3], 2.0))
    exact = scene("damped_pendulum", gamma=1e-300).flow(q, p, s, t)
    assert slopes(model, torch.cat([x.reshape(-1) for x in exact])) == pytest.approx([2, 2, 2], abs=0.1)


def test_viscous_friction_is_second_order():
    # fails if F⁻ is not c (h/2) f or F⁺ not (h/2) f: order 1 then; half the damping comes from s, half from friction
    model = build(ModelConfig(level="forced", rate=0.35, potential_width=0))
    with torch.no_grad():
        model.friction.viscous.fill_(0.25)
    q, p, s, t = (torch.tensor(x, dtype=torch.float64) for x in ([[1.2]], [[0.7]], [0.3], 2.0))
    exact = scene("damped_pendulum", gamma=0.6).flow(q, p, s, t)
    error = lambda k: (end(model, k)[:2] - torch.cat([exact[0][0], exact[1][0]])).abs()  # noqa: E731
    assert torch.log2(error(40) / error(80)).tolist() == pytest.approx([2, 2], abs=0.1)


def test_affine_drag_is_second_order():
    # fails if the drag λ enters c with the wrong factor: c = e^{2λΔ} of quadratic drag
    model = build(
        ModelConfig(angles=(False,), level="affine", rate=0.0, damping_width=0, potential_width=0, stiffness=(0.0,))
    )
    with torch.no_grad():
        model.damping.drag.fill_(0.5)
    q, p, s, t = (torch.tensor(x, dtype=torch.float64) for x in ([[1.2]], [[0.7]], [0.3], 2.0))
    exact = scene("quadratic_drag", lam=0.25).flow(q, p, s, t)
    assert slopes(model, torch.cat([x.reshape(-1) for x in exact])) == pytest.approx([2, 2, 2], abs=0.1)


def random_networks(config, size=0.5) -> Any:
    model = build(config)
    randomise(model, size, seed=3)
    with torch.no_grad():
        if config.coulomb:
            model.friction.coulomb.abs_()
            model.friction.log_smooth.fill_(0.0)  # wide: the asymptotic order needs h to resolve it
            model.friction.log_stribeck.fill_(0.0)
    return model


@pytest.mark.parametrize(
    "config",
    [
        ModelConfig(level="full", potential_width=4),
        ModelConfig(level="full", action_width=1, rate=0.5),
        ModelConfig(mass_width=6, rate=0.5),
        ModelConfig(mass_width=6, level="affine", damping_width=4),
        ModelConfig(
            angles=(True, False), scale=(1.0, 1.0), speed=(1.0, 1.0), stiffness=(1.0, 2.0), tilt=(0.0, 0.1),
            level="forced", coulomb=True, mass_width=4, potential_width=0,
        ),
        ModelConfig(level="full", dissipation=("s^2", "s^3"), rate=0.5),
        ModelConfig(level="forced", dissipation=("s^3", "s^2"), coulomb=True, drag=("cos(q1) v1",), rate=0.5),
    ],
    ids=["full", "one unit", "mass", "mass affine", "mass forced", "powers of s", "powers of s, forces"],
)  # fmt: skip
def test_every_weight_gives_second_order(config):
    # fails if the units or powers of s are not composed in opposite orders, m is taken at an end, or forces have the
    # weight e^g where 1 + D3 is another number: order 1 then (trap 1)
    model = random_networks(config)
    x = [end(model, k, h_total=1.0) for k in (16, 32, 64)]
    exact = x[2] + (x[2] - x[1]) / 3  # Richardson: right to order 4, as the step is its own adjoint
    coarse, fine = (float((y - exact).norm()) for y in x[:2])
    assert math.log2(coarse / fine) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("level", ["conservative", "linear", "affine", "full"])
def test_a_step_back_is_the_inverse(level):
    # fails if a term is not symmetric under q0 ↔ q1, h → −h: what makes the order even
    model = random_networks(ModelConfig(level=level, mass_width=4))  # N stands outside: trained at one h
    make = torch.Generator().manual_seed(1)
    q0, q1 = torch.randn(2, 5, 1, generator=make, dtype=torch.float64)
    s0, h = torch.randn(5, generator=make, dtype=torch.float64), torch.full((5,), 0.3).double()
    with torch.no_grad():
        s1 = s0 + model(q0, q1, s0, h)
        torch.testing.assert_close(s1 + model(q1, q0, s1, -h), s0, rtol=1e-12, atol=1e-12)


def test_a_unit_of_the_full_level_is_an_exact_flow():
    # fails if the closed form of asinh(eᵃ sinh x) − x, or one of its derivatives, is wrong or overflows
    x = torch.tensor([-3.0, -0.4, 0.0, 1e-9, 0.7, 5.0], dtype=torch.float64)
    for a in (-1.5, -1e-6, 0.0, 0.3, 2.0):
        a = torch.tensor(a, dtype=torch.float64)
        y = unit_increment(Jet(torch.stack([x, torch.ones_like(x), torch.zeros_like(x)]), 1, 2), a)
        torch.testing.assert_close(y.value, torch.asinh(a.exp() * x.sinh()) - x, rtol=1e-12, atol=2e-15)
        slope = a.exp() * x.cosh() / (1 + (a.exp() * x.sinh()) ** 2).sqrt() - 1
        torch.testing.assert_close(y.gradient[0], slope, rtol=1e-11, atol=2e-15)
        half = unit_increment(Jet(torch.stack([x, torch.ones_like(x)]), 1, 1), a / 2).value
        rest = unit_increment(Jet(torch.stack([x + half, torch.ones_like(x)]), 1, 1), a / 2).value
        torch.testing.assert_close(half + rest, y.value, rtol=1e-12, atol=1e-15)
    for dtype in (torch.float32, torch.float64):  # sinh would overflow
        far = torch.tensor([-1e4, 1e4], dtype=dtype)
        y = unit_increment(Jet(torch.stack([far, torch.ones_like(far), far * 0]), 1, 2), torch.tensor(0.5, dtype=dtype))
        torch.testing.assert_close(y.value, torch.tensor([-0.5, 0.5], dtype=dtype))
        assert torch.equal(y.gradient[0], torch.zeros_like(far))


def test_damping_can_rise_and_fall_with_s_and_c_stays_positive():
    # fails if the slope of the s-map is bounded on one side, as with positive weights alone, or can reach 0
    s = torch.linspace(-60, 60, 2001, dtype=torch.float64)
    q, h = torch.zeros(2001, 1, dtype=torch.float64), torch.full((2001,), 0.5, dtype=torch.float64)
    for rate in (-20.0, -3.0, 3.0, 20.0):
        model = build(ModelConfig(level="full", action_width=1, rate=0.2))
        with torch.no_grad():
            model.action.rate.fill_(rate)
            model.action.bias.zero_()
            model.action.weight.zero_()
            c = model.partials(q, q, s, h).c
        assert c.min() > 0
        middle = math.log(float(c[1000]))  # s = 0, x = 0 after V0 = 0
        assert middle == pytest.approx(0.5 * (rate - 0.2), rel=1e-9)
        assert float(c[1000]) == float(c.min() if rate < 0 else c.max())
        assert float(c[0]) == pytest.approx(math.exp(-0.1), rel=1e-6)  # far away: the linear level
    with torch.no_grad():
        for seed in range(20):
            model = random_networks(ModelConfig(level="full", seed=seed), size=3.0)
            assert model.partials(q, q + 0.3, s, h).c.min() > 0


def test_mass_is_positive_definite_bounded_and_fixed_at_the_origin():
    # fails if the scale of m is free (gauge), the diagonal is unbounded, or m is not what K uses
    config = ModelConfig(
        angles=(True, False), scale=(1.0, 2.0), speed=(1.0, 1.0), stiffness=(1.0,) * 2, tilt=(0.0,) * 2,
        level="conservative", mass_width=6, potential_width=0,
    )  # fmt: skip
    model = random_networks(config, size=1.0)
    with torch.no_grad():
        assert float(model.kinetic.mass(torch.zeros(1, 2).double())[0, 0, 0]) == pytest.approx(1.0, abs=1e-15)
        make = torch.Generator().manual_seed(0)
        q, v = torch.randn(2, 50, 2, generator=make, dtype=torch.float64)
        m = model.kinetic.mass(q)
        assert torch.linalg.eigvalsh(m).min() > 0
        assert float((m[:, 0, 0] - 1).abs().max()) > 0.1
        h = torch.tensor(0.1, dtype=torch.float64)
        K = model.terms(Phase(q - h / 2 * v, q + h / 2 * v, h.expand(50), 1, config)).K
        torch.testing.assert_close(K.value, h / 2 * (v * (m @ v[..., None])[..., 0]).sum(-1), rtol=1e-12, atol=1e-13)
        for parameter in model.kinetic.network.parameters():
            parameter *= 1e3
        scaled = model.kinetic.mass(q)[:, 0, 0]
        assert float(scaled.max()) <= 54.6
        assert float(scaled.min()) >= 1 / 54.6  # e^±4


@pytest.mark.parametrize("name", ["tanh", "softplus", "silu"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_activations_and_their_derivatives(name, dtype):
    # fails if a derivative is wrong, cancels, or is not finite far out in float32
    x = torch.tensor([-1e30, -90.0, -30.0, -2.0, 0.0, 0.5, 25.0, 90.0, 1e30], dtype=dtype)
    y = getattr(Jet(torch.stack([x, torch.ones_like(x), torch.zeros_like(x)]), 1, 2), name)()
    assert bool(torch.isfinite(y.data).all())
    exact = {"tanh": torch.tanh, "softplus": lambda z: torch.logaddexp(z, torch.zeros_like(z)),
             "silu": lambda z: z * torch.sigmoid(z)}[name]  # fmt: skip
    z = x[2:8].double().requires_grad_()
    first = torch.autograd.functional.jvp(exact, z.detach(), torch.ones_like(z))[1]
    slope = lambda z: torch.autograd.functional.jvp(exact, z, torch.ones_like(z), create_graph=True)[1]  # noqa: E731
    second = torch.autograd.functional.jvp(slope, z.detach(), torch.ones_like(z))[1]
    tol = 1e-12 if dtype == torch.float64 else 1e-6
    torch.testing.assert_close(y.value[2:8].double(), exact(z).detach(), rtol=tol, atol=tol)
    torch.testing.assert_close(y.gradient[0, 2:8].double(), first, rtol=tol, atol=tol)
    torch.testing.assert_close(y.data[2, 2:8].double(), second, rtol=tol, atol=tol)


def test_dry_friction_holds_and_breaks_away():
    # fails if Coulomb friction does not oppose motion, or Stribeck's peak is missing
    model = build(ModelConfig(level="forced", coulomb=True))
    with torch.no_grad():
        model.friction.coulomb.fill_(0.5)
        model.friction.breakaway.fill_(0.3)
        v = torch.tensor([[-2.0], [-0.1], [0.0], [0.1], [2.0]], dtype=torch.float64)
        f = model.friction.value_and_slope(v, None)[0][:, 0]
    assert f[2] == 0
    assert f[0] == pytest.approx(0.5)
    assert f[4] == pytest.approx(-0.5)
    assert float(-f[3]) > 0.65  # above the sliding force
    assert float(f[1]) == pytest.approx(float(-f[3]))
    start = State(*(torch.tensor(x, dtype=torch.float64) for x in ([[0.3]], [[0.0]], [0.0])))
    with torch.no_grad():
        model.damping.rate.zero_()
        out = Stepper(model).rollout(*start, h=0.05, steps=100)
    moved = float((out.q[0, -1] - 0.3).abs())
    assert moved < 0.1  # sin 0.3 is below the breakaway force: it creeps, and does not swing
