"""Set-valued dry friction: the inclusion holds, joints stand still, every step has a solution and a derivative."""

import math
from typing import Any

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import partials
from herglotz.mechanics.legendre import unheld_residual
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper

H = 0.05


def joints(n=1, seed=0, stiffness=1.0, scale=1.0, **settings) -> Any:
    """n joints with springs, coupled by the mass, whose friction is drawn at random."""
    make = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=make, dtype=torch.float64)  # noqa: E731
    sizes = {"angles": (False,) * n, "scale": (1.0,) * n, "speed": (1.0,) * n}
    model: Any = ContactLagrangian(
        ModelConfig(
            level="forced", coulomb=True, sticking=True, rate=0.1, potential_width=0, tilt=(0.0,) * n,
            stiffness=(stiffness,) * n, inputs=1, **sizes, **settings,
        )
    )  # fmt: skip
    with torch.no_grad():
        model.friction.coulomb.copy_(scale * draw(n))
        model.friction.breakaway.copy_(scale * draw(n) / 2)
        model.friction.viscous.copy_(draw(n) / 5)
        model.friction.log_stribeck.copy_((0.05 + draw(n)).log())
        model.friction.input_map.copy_(draw(n, 1))
        if n > 1:
            model.kinetic.off_diagonal.copy_(draw(n * (n - 1) // 2) - 0.5)
    return model


def starts(count, n, seed=0):
    make = torch.Generator().manual_seed(seed)
    return (torch.randn(count, n, generator=make, dtype=torch.float64) for _ in range(2))


def test_one_joint_against_the_closed_form():
    # fails if the threshold, its unit or the share of F⁻ is wrong: soft thresholding of the push at v = 0
    model, (q, p) = joints(), starts(200, 1)
    with torch.no_grad():
        model.friction.breakaway.zero_()
    tau, b, c = model.friction.coulomb.item(), model.friction.viscous.item(), math.exp(-0.1 * H)
    push = c * (p - H / 2 * q)
    bound = c * H * tau
    # The factor of v in F: √c m + c (h/2) b.
    mass = c**0.5 + c * H / 2 * b
    expected = (push - push.clamp(-bound, bound)) / mass * H
    with torch.no_grad():
        step = Stepper(model).step(State(q, p, torch.zeros(200).double()), H)
    assert bool((expected == 0).any())
    assert bool((expected != 0).any())
    torch.testing.assert_close(step.state.q - q, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_every_step_satisfies_the_inclusion(n):
    # fails if a joint slides against too small a force, sticks beyond it, or friction pushes (creates energy)
    for seed in range(8):
        model, (q, p) = joints(n, seed, scale=10.0 ** (seed - 5)), starts(100, n, seed)
        h = 10.0 ** (-(seed % 4))
        with torch.no_grad():
            step = Stepper(model).step(State(q, p, torch.zeros(100).double()), h)
            assert bool((step.status == 0).all())
            delta = step.state.q - q
            P, rest = (partials(model, q, x, torch.zeros(100).double(), h) for x in (step.state.q, q))
        assert P.force is not None
        assert rest.force is not None
        held = rest.force.held
        assert held is not None
        # The force that friction has to hold where Δ = 0; where Δ ≠ 0 the residual contains friction.
        left = unheld_residual(P, p)
        size = 1e-12 * (p.abs().amax(-1, keepdim=True) + held + 1)
        sticks = delta == 0
        assert bool((left.abs() <= torch.where(sticks, held, 0.0) + size).all())
        # Friction and viscous force both brake.
        slide = -P.force.minus.sign()
        assert bool((slide == delta.sign())[~sticks & (delta.abs() > 1e-9)].all())


def test_a_joint_stands_still_until_it_is_pushed_off():
    # fails if rest creeps, momentum flips from step to step, or breakaway comes at another force than τ + ε
    model = joints(stiffness=0.0)
    gain = model.friction.input_map.item()
    hold = (model.friction.coulomb + model.friction.breakaway).item() / gain
    u = torch.cat([torch.linspace(0, 0.999 * hold, 50), torch.full((5,), 1.001 * hold)]).double()[:, None]
    with torch.no_grad():
        run = Stepper(model).rollout(torch.zeros(1).double(), torch.zeros(1).double(), h=H, inputs=u)
    assert bool(run.ok)
    assert bool((run.q[:51] == 0).all())
    assert bool((run.q[52:] > 0).all())


def test_motion_comes_to_rest_and_stays():
    # fails if sticking ends without a force: a spring within the dead band; all rest after 204 steps
    model, (q, p) = joints(2, seed=3), starts(50, 2)
    with torch.no_grad():
        run = Stepper(model).rollout(q / 2, p / 2, h=H, steps=240)
    assert bool(run.ok.all())
    assert bool((run.q[:, -1] == run.q[:, -30]).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_no_status_but_converged_at_reversals(dtype):
    # fails if an iteration cycles between sticking and sliding: pushed to and fro, 3 joints, steps of three sizes
    model, (q, p) = joints(3, seed=1).to(dtype), starts(40, 3)
    make = torch.Generator().manual_seed(0)
    u = 4 * torch.randn(40, 40, 1, generator=make, dtype=torch.float64).to(dtype)
    with torch.no_grad():
        for h in (1e-3, 0.05, 0.5):
            run = Stepper(model).rollout(q.to(dtype), p.to(dtype), h=h, inputs=u)
            assert bool((run.status == 0).all())


def test_alone_as_in_a_batch():
    # fails if the sticking of a sample changes another sample
    model, (q, p) = joints(2, seed=5), starts(6, 2)
    with torch.no_grad():
        together = Stepper(model).rollout(q, p, h=H, steps=12)
        alone = [Stepper(model).rollout(a, b, h=H, steps=12).q for a, b in zip(q, p, strict=True)]
    torch.testing.assert_close(together.q, torch.stack(alone), rtol=1e-12, atol=1e-13)


def test_derivatives_of_sticking_and_sliding_joints():
    # fails if a held joint's row is F's in place of Δ = 0's, in autograd or in `linearise`
    model = joints(2, stiffness=1.0)
    with torch.no_grad():
        model.friction.coulomb.copy_(torch.tensor([0.5, 0.2]))
    stepper = Stepper(model)

    def step(z):
        out = stepper.step(State(z[:2], z[2:4], z[4]), H).state
        return torch.cat([out.q, out.p, out.s[None]])

    for z in ([0.35, -1.5, 0.02, 0.4, 0.1], [0.1, -0.1, 0.0, 0.0, 0.0], [1.0, 1.0, -2.0, 0.7, 0.3]):
        z = torch.tensor(z, dtype=torch.float64)
        eps = 1e-5
        with torch.no_grad():
            differences = [(step(z + eps * e) - step(z - eps * e)) / (2 * eps) for e in torch.eye(5).double()]
            found = stepper.linearise(State(z[:2], z[2:4], z[4]), H).by_state
        torch.testing.assert_close(found, torch.stack(differences, 1), rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(torch.autograd.functional.jacobian(step, z), found, rtol=1e-10, atol=1e-12)


def test_sticking_is_of_dry_friction():
    # fails if a model without dry friction accepts `sticking`
    with pytest.raises(InputError, match="sticking is of dry friction; set coulomb=True"):
        ModelConfig(level="forced", sticking=True)
