"""What the data leave open, where the answer is known."""

from typing import Any

import torch

from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.training import FitConfig, Run, laplace, traded
from herglotz.training.recorded_range import box_of
from herglotz.training.trades import LARGEST, in_words, listed, sparse_basis
from herglotz.training.uncertainty import schur

NOISE, H = 1e-3, 0.2


def recorded(*, angle=False, driven=True, torque=1.0, count=3, steps=40):
    """A run at the very parameters that made its data: a joint with damping, under a random torque or free."""
    make = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=make, dtype=torch.float64)  # noqa: E731
    force: dict[str, Any] = {"level": "forced", "inputs": 1, "input_zero": True} if driven else {"level": "linear"}
    sizes: dict[str, Any] = {"scale": (2.0,), "speed": (2.0,), "stiffness": (1.0,), "tilt": (0.1,)}
    model: Any = ContactLagrangian(ModelConfig(rate=0.1, potential_width=0, angles=(angle,), **force, **sizes))
    u = torque * draw(count, steps + 1, 1) if driven else None
    with torch.no_grad():
        if driven:
            model.friction.viscous.fill_(0.1)
            model.friction.input_map.fill_(0.7)
        inputs = None if u is None else u[:, :-1]
        x = Stepper(model).rollout(draw(count, 1), draw(count, 1), h=H, steps=steps, inputs=inputs)
    states = State(x.q.flatten(0, 1), x.p.flatten(0, 1), x.s.flatten())
    t = (H * torch.arange(steps + 1, dtype=torch.float64)).repeat(count)
    data = Trajectories.of(
        t, states.q + NOISE * draw(*states.q.shape), (steps + 1,) * count, angles=(angle,),
        u=None if u is None else u.flatten(0, 1),
    )  # fmt: skip
    config, metrics = FitConfig(level=model.config.level), {"sigma": NOISE, "departure": None}
    return Run(model, config, metrics, data, data.lengths, states, H, box_of(*states), [])


def test_two_names_for_one_force():
    # fails if the prior's information counts as the data's, exact null directions are lost in a pseudo-inverse, or two
    # null directions are mixed: on a straight joint a constant force is a tilt or the sensor's zero, and one joint's
    # damping is γ or viscous friction
    posterior = laplace(recorded())
    trades = traded(posterior)
    pairs = [{name for name, _ in trade.parts} for trade in trades]
    assert len(pairs) == 2
    assert {"potential.tilt", "friction.input_zero"} in pairs
    assert {"damping.rate", "friction.viscous"} in pairs
    for trade in trades:
        assert trade.index > LARGEST / 100
        assert "cannot be told apart" in str(trade) or "hard to tell apart" in str(trade)
    std = posterior.standard_deviations()
    assert float(std["potential.tilt"]) > 10
    assert float(std["potential.stiffness"]) < 1e-3


def test_equal_directions_are_told_apart_whatever_basis_rounding_chose():
    # fails if the basis of a null space depends on rounding, or two directions that share no parameter are mixed
    first, second = torch.tensor([[3.0, 0, -4, 0, 0], [0, 1, 0, 2, -2]], dtype=torch.float64) / torch.tensor(
        [[5.0], [3]]
    )
    for angle in torch.linspace(0.0, 3.0, 25, dtype=torch.float64):
        turned = torch.stack(
            [angle.cos() * first + angle.sin() * second, angle.cos() * second - angle.sin() * first], 1
        )
        basis = sparse_basis(turned + 1e-14 * torch.randn(5, 2, generator=torch.Generator().manual_seed(0)).double())
        found = sorted((v * v.sum().sign()).tolist() for v in basis.T)
        expected = sorted((v * v.sum().sign()).tolist() for v in (first, second))
        torch.testing.assert_close(torch.tensor(found), torch.tensor(expected), rtol=0, atol=1e-12)


def test_gravity_tells_the_zero_of_the_sensor():
    # fails if a well determined pair is called traded: gravity turns with the angle, the sensor's zero does not
    for trade in traded(laplace(recorded(angle=True))):
        assert "friction.input_zero" not in dict(trade.parts)


def test_a_free_motion_leaves_nothing_open():
    # fails if there is always something to report
    posterior = laplace(recorded(driven=False))
    assert traded(posterior) == []
    assert 2.5 < posterior.effective_parameters() < 3.01  # stiffness, tilt, rate


def test_what_never_acted_is_named():
    # fails if a parameter without effect is taken for a determined one
    posterior = laplace(recorded(angle=True, torque=0.0))
    assert all(bool(std.isfinite().all()) for std in posterior.standard_deviations().values())
    assert 3.5 < posterior.effective_parameters() < 5.01
    trades = traded(posterior)
    lone = [trade for trade in trades if len(trade.parts) == 1]
    assert [trade.parts[0][0] for trade in lone] == ["friction.input_map"]
    assert "the map from inputs to forces has next to no effect" in str(lone[0])


def test_names_in_words():
    # fails if an entry is counted from 0, or an unknown name is lost
    assert in_words("friction.viscous[1]") == "viscous friction, entry 2"
    assert in_words("damping.rate") == "the damping rate γ"
    assert in_words("new.thing") == "new.thing"


def test_names_of_columns_may_have_numbers_in_brackets():
    # fails if a term with the column effort[0], as ROS writes it, is read as an entry of a parameter, or ends the fit
    assert listed(("friction.viscous[1]", "x effort[0]", "effort[0] q1", "mass")) == (
        "viscous friction (2), x effort[0], effort[0] q1, mass"
    )


def test_chaos_leaves_information_of_its_own():
    # fails if the information is a difference of numbers 1e11 times as large, where errors of the start grow by e^14:
    # with a pseudo-inverse it was 28 000 times as large, and in a longer motion negative, "next to no effect"
    t = torch.linspace(0, 14, 200, dtype=torch.float64)
    lost = t.exp()
    J = torch.stack([lost + t.sin(), 0.1 * lost + t.cos(), 3 * lost + (2 * t).sin(), 0.5 * lost + (3 * t).cos()], -1)
    R = torch.linalg.qr(J).R[2:, 2:]
    found, exact = schur(J.T @ J, 2), R.T @ R
    assert torch.allclose(found, exact, rtol=0, atol=0.1 * float(exact.diagonal().min()))
    # Without a factor, as where two numbers are one, the difference stands.
    J[:, 3] = 2 * J[:, 2] - J[:, 0]
    assert torch.isfinite(schur(J.T @ J, 2)).all()
