"""The peers of `benchmarks/peers` have the structure that their papers claim, and learn what they can."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from matplotlib.image import imread

from benchmarks import harness
from benchmarks.peers import PEERS, __main__, continuous, discrete, networks
from benchmarks.peers.known_equation import Equation
from benchmarks.peers.networks import Network
from benchmarks.peers.packages import Learned
from benchmarks.peers.problems import DOUBLE, PROBLEMS, double_momentum, double_motion, errors, pendulum
from benchmarks.peers.rollouts import Flow, ThreePoint, fitted_start, rk4
from benchmarks.peers.samples import Motion, Samples, differences
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.stepping import Stepper
from tests.compared import f64

H = 0.25


def oscillator(damping=0.0, exact=True):
    """q̈ = −q − d q̇ in closed form (d = 0) or by short steps; 6 × 21 positions."""
    make = torch.Generator().manual_seed(3)
    y = 2 * torch.rand(6, 2, generator=make, dtype=torch.float64) - 1
    rows = [y]
    field = lambda y: torch.stack([y[:, 1], -y[:, 0] - damping * y[:, 1]], -1)  # noqa: E731
    for _ in range(20):
        rows.append(rk4(field, rows[-1], H, 20))
    x = torch.stack(rows, 1)
    q, v = x[..., :1], x[..., 1:]
    a = -q - damping * v
    motion = tuple(Motion(q[i], v[i], v[i], a[i], a[i]) for i in range(6)) if exact else None
    return Samples(tuple(q), H, (False,), False, motion)


def rollouts(model, samples):
    q = torch.stack(samples.q)
    exact = samples.exact and torch.stack([torch.cat([m.q[1], m.v[1]]) for m in samples.exact])
    return model.rollout(q[:, 0], q[:, 1], 19, exact), q


def scales_and_state(n=2):
    make = torch.Generator().manual_seed(0)
    q, v = (torch.rand(7, n, generator=make, dtype=torch.float64) for _ in range(2))
    samples = Samples((q,), H, (True,) * n)
    return networks.scales_of(samples, Motion(q, v, v, v + 1, v)), q, v, make


def test_differences_are_exact_on_a_parabola_and_fourth_order_on_a_sine():
    # fails if a weight is wrong or h enters with the wrong power
    t = H * torch.arange(9, dtype=torch.float64)[:, None]
    for noisy in (False, True):
        m: Any = differences(3 * t**2 - t, H, noisy)
        assert torch.allclose(m.v, 6 * t[2:-2] - 1)
        assert torch.allclose(m.a, torch.full_like(m.a, 6.0))
    k = torch.arange(9, dtype=torch.float64)[:, None]
    sines: list[Any] = [differences((h * k).sin(), h, False) for h in (0.2, 0.1)]
    worst = [float((m.v - (h * k)[2:-2].cos()).abs().max()) for m, h in zip(sines, (0.2, 0.1), strict=True)]
    assert 12 < worst[0] / worst[1] < 20


def test_hnn_conserves_its_hamiltonian_and_the_dissipative_one_does_not():
    # fails if the symplectic gradient has a wrong sign, or the dissipative term is missing
    scales, q, p, make = scales_and_state()
    for dissipative in (False, True):
        model = continuous.Hamiltonian(scales, make, dissipative=dissipative)
        q_rate, p_rate = model.rates(q.clone(), p.clone())
        q, p = q.detach().requires_grad_(), p.detach().requires_grad_()
        H_q, H_p = torch.autograd.grad(model.energy * model.H(scales.of_state(q, p)).sum(), (q, p))
        power = (H_q * q_rate + H_p * p_rate).sum(-1).detach()
        assert (float(power.abs().max()) > 1e-3) == dissipative
        assert dissipative or float(power.abs().max()) < 1e-12


def test_accelerations_of_a_known_lagrangian():
    # fails if the mixed derivative ∂²L/∂q∂v is transposed or its sign is wrong: the double pendulum has both
    system = scene("double_pendulum", gamma=0.0)
    _, q, v, _ = scales_and_state()
    q, v = q.requires_grad_(), v.requires_grad_()
    zero = torch.zeros(len(q), dtype=torch.float64)
    found = continuous.acceleration(system.lagrangian(q, v, zero), q, v)
    theta = DOUBLE.clone()
    theta[:, 4:] = 0.0
    want = Equation(relative=False).acceleration(q, v, theta.expand(len(q), -1))
    assert torch.allclose(found, want, atol=1e-12)


def test_delan_loses_its_energy_to_friction_alone():
    # fails if the Coriolis term of M(q) is wrong, M is not positive definite, or friction has the wrong sign
    scales, q, v, make = scales_and_state()
    model = continuous.DeepLagrangian(scales, make)
    assert float(torch.linalg.eigvalsh(model.mass(q).detach()).min()) > 0
    a = model.rates(q.clone(), v)[1].detach()
    w = lambda v: v / scales.v  # noqa: E731

    def energy(q, v):
        T = (w(v) * (model.mass(q) @ w(v)[..., None])[..., 0]).sum(-1) / 2
        return T + model.potential(scales.of_q(q))[:, 0]

    q, v = q.detach().requires_grad_(), v.requires_grad_()
    E_q, E_v = torch.autograd.grad(energy(q, v).sum(), (q, v))
    power = (E_q * v + E_v * a).sum(-1)
    loss = (model.log_friction.exp() * w(v).square()).sum(-1)
    assert torch.allclose(power, -loss, atol=1e-12)


def test_discrete_lagrangian_is_a_free_particle_without_its_network_and_forces_enter():
    # fails if D1 and D2 are exchanged, a scale is wrong, or the force is left out
    samples = oscillator(exact=False)
    make = torch.Generator().manual_seed(0)
    net, force = Network(2, 1, make), Network(2, 1, make)
    model = discrete.DiscreteLagrangian(discrete.scales_of_triples(samples), H, net, force)
    with torch.no_grad():
        for weight in (*net.parameters(), *force.parameters()):
            weight.zero_()
    q0, q1, q2 = samples.triples()
    want = -(q2 - 2 * q1 + q0) / (H**2 * model.scales.a)
    assert torch.allclose(model.residual(q0, q1, q2), want, atol=1e-12)
    assert torch.allclose(model.mixed(q0, q1), torch.ones(len(q0), 1, 1, dtype=torch.float64))
    with torch.no_grad():
        [*force.parameters()][-1].fill_(1.0)  # a constant force
    assert torch.allclose(model.residual(q0, q1, q2), want + 1, atol=1e-12)
    drift = ThreePoint(lambda a, b, c: c - 2 * b + a, 0).rollout(f64([0.0]), f64([0.5]), 3)
    assert torch.allclose(drift[0, :, 0], f64(0.0, 0.5, 1.0, 1.5, 2.0))


LONGER = [pytest.param(name, marks=pytest.mark.slow) for name in ("dissipative_hnn", "delan", "mlp", "neural_ode")]


@pytest.mark.usefixtures("optimisers_are_imported")
@pytest.mark.parametrize("name", ["hnn", "forced_discrete_lagrangian", *LONGER])
def test_peers_learn_an_oscillator_in_seconds(name):
    # fails if a peer's training does nothing: its untrained rollouts are off by more than half the amplitude
    if name == "neural_ode":
        pytest.importorskip("torchdiffeq", reason="torchdiffeq is an extra of the benchmarks")
    samples = oscillator(exact=PEERS[name].needs != "positions")
    model = PEERS[name].train(samples, 0, 2.5 if name == "neural_ode" else 1.6)
    found = errors(*rollouts(model, samples), None)
    assert found["failures"] == 0
    assert found["rms"] < 0.1, found


def test_sindy_finds_the_terms_of_a_damped_pendulum():
    pytest.importorskip("pysindy", reason="pysindy is an extra of the benchmarks")
    # fails if the library misses sin q or v, or thresholds drop one of them
    samples = PROBLEMS["pendulum_one"]().samples(0, True)
    model: Any = PEERS["sindy"].train(samples, 0, 1.0)
    rates = model.field(f64([0.7, 0.4]))
    assert model.parameters == 2
    assert torch.allclose(rates[0], torch.stack([f64(0.4), -f64(0.7).sin() - 0.2 * 0.4])[:, 0], atol=1e-8)


@pytest.mark.slow
def test_phlearn_trains():
    pytest.importorskip("phlearn", reason="phlearn is an extra of the benchmarks")
    # fails if the package's interface changed
    samples = oscillator(damping=0.2)
    found = [errors(*rollouts(PEERS["phlearn"].train(samples, 0, s), samples), None)["rms"] for s in (1e-3, 1.0)]
    assert found[1] < 0.3 * found[0], found


def test_double_pendulum_in_joint_angles_is_the_scene_without_friction():
    # fails if the angle between the arms is taken for an absolute one, or the momentum is not ∂L/∂v
    system, theta = scene("double_pendulum", gamma=0.0), DOUBLE.clone()
    theta[:, 4:] = 0.0
    q, v = f64([0.9, -0.4]), f64([0.3, 0.7])
    y = torch.cat([q, v], -1)
    field = lambda y: torch.cat([y[:, 2:], Equation(True).acceleration(y[:, :2], y[:, 2:], theta)], -1)  # noqa: E731
    y = rk4(field, y, 0.2, 200)
    state = (q.cumsum(-1), system.momentum(q.cumsum(-1), v.cumsum(-1), f64(0.0)), f64(0.0))
    q_end, p_end, _ = system.flow(*state, 0.2)
    assert torch.allclose(y[:, :2].cumsum(-1), q_end, atol=1e-9)
    assert torch.allclose(double_momentum(y[:, :2], y[:, 2:])[:, 1], p_end[:, 1], atol=1e-9)
    damped = double_motion(q, 0 * v, 0.02, 3)[0]
    assert damped.shape == (1, 3, 2)


def test_shooting_meets_the_second_position_and_starts_are_found_from_noiseless_history():
    # fails if Newton's slope is wrong, or a missing sample counts as one
    field = lambda y: torch.stack([y[:, 1], -y[:, 0].sin()], -1)  # noqa: E731
    model = Flow(field, H, 4, 0)
    q0, q1 = f64([0.3], [-1.0]), f64([0.5], [-0.9])
    v = model.shoot(q0, q1)
    assert torch.allclose(model.advance(torch.cat([q0, v], -1))[:, :1], q1, atol=1e-12)
    history = model.rollout(q0, q1, 18)
    spoiled = history.clone()
    spoiled[:, 5] = torch.nan
    spoiled[:, :2] += 0.01  # the guess
    spoiled[:, 0], spoiled[:, 1] = history[:, 0] + 0.01, history[:, 1] - 0.01
    found = fitted_start(model, torch.cat([spoiled[:, :2], spoiled[:, 2:]], 1), 12)
    ahead = model.rollout(*found, 18)
    assert float((ahead[:, 2:] - history[:, 2:]).abs().max()) < 0.01


def test_errors_count_lost_rollouts_and_leave_no_nan():
    # fails if a rollout that blew up enters the RMS, or the median ignores it
    truth = torch.zeros(4, 6, 1, dtype=torch.float64)
    found = truth + 0.1
    found[0, 4] = torch.nan
    out = errors(found, truth, None)
    assert (out["failures"], out["rollouts"]) == (1, 4)
    assert out["rms"] == pytest.approx(0.1)
    found[1:3] = torch.inf
    assert errors(found, truth, None)["median"] is None


def test_neural_ode_steps_as_the_classical_rule_does():
    pytest.importorskip("torchdiffeq", reason="torchdiffeq is an extra of the benchmarks")
    # fails if the package's step is not of fourth order
    field = lambda y: torch.stack([y[:, 1], -y[:, 0]], -1)  # noqa: E731
    y = f64([0.4, -0.2])
    assert torch.allclose(continuous.integrator(field, 0.2, 2)(y), rk4(field, y, 0.2, 2), atol=1e-6)


def test_the_command_resumes_and_refuses_other_settings(tmp_path, capsys):
    # fails if a finished cell is fitted again, or results of two budgets are mixed; and if the elimination of the
    # starts in the fit of the known equation is wrong: it then stalls far from the truth
    arguments = ["--data", "pendulum_one", "--peers", "known_equation", "--seeds", "1", "--out", str(tmp_path)]
    __main__.main([*arguments, "--budget", "1"])
    path = tmp_path / "peers.json"
    first = json.loads(path.read_text())
    key = "pendulum_one/known_equation/positions/0"
    assert first["cells"][key]["rms"] < 1e-6
    first["cells"][key]["rms"] = 1.0
    path.write_text(json.dumps(first))
    __main__.main([*arguments, "--budget", "1"])
    assert json.loads(path.read_text())["cells"][key]["rms"] == 1.0
    assert "known equation" in (tmp_path / "peers.md").read_text()
    picture = imread(tmp_path / "peers.png")
    assert min(picture.shape[:2]) > 100
    assert picture.std() > 0.05  # not an empty page
    with pytest.raises(SystemExit, match="other settings"):
        __main__.main([*arguments, "--budget", "2"])
    with pytest.raises(SystemExit, match="2"):
        __main__.main(["--peers", "who"])
    assert "unknown peer 'who'" in capsys.readouterr().err


def test_exact_rates_do_not_follow_noisy_positions():
    # fails if the exact acceleration is that at the noisy position: a method could then learn from it without noise
    m = pendulum(0.2, noise=0.01, trajectories=3).samples(0, True).motion()
    off = m.a + m.q.sin() + 0.2 * m.v
    assert 0.002 < float(off.std()) < 0.02


def test_measured_problems_split_at_gaps():
    if not (harness.DATA / "schmidt_lipson_2009").is_dir():
        pytest.skip("the measured data are not here; data/README.md says where to get them")
    # fails if a gap is taken for a step
    samples = PROBLEMS["real_pendulum"]().samples(0, False)
    assert len(samples.q) == 11
    assert sum(len(q) for q in samples.q) == 371
    assert replace(samples, exact=None).motion().q.shape == (371 - 4 * 11, 1)


@pytest.mark.parametrize("parts", [1, 4])
def test_a_learned_model_takes_its_own_steps(parts):
    # fails if a recorded step, of which the fit made several, is one step of the rollout: its error is then the larger
    # step's, and not the model's
    shape: Any = {"scale": (1.0,), "speed": (1.0,), "stiffness": (1.0,), "tilt": (0.0,), "rate": 0.1}
    model = ContactLagrangian(ModelConfig((False,), **shape, potential_width=0))
    q, p = f64([0.4], [-0.7]), f64([0.3], [0.1])
    with torch.no_grad():
        motion = Stepper(model).rollout(q, p, f64(0, 0), h=H / parts, steps=20 * parts).q[:, ::parts]
    run: Any = SimpleNamespace(model=model, h=H / parts, metrics={"parameters": 0})
    torch.testing.assert_close(Learned(run, H).rollout(q, motion[:, 1], 19), motion, rtol=0, atol=1e-12)
