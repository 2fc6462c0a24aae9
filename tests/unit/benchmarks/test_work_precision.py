"""The benchmark of error against cost: it must measure what it says."""

import math

import pytest
import torch

pytest.importorskip("scipy", reason="scipy is an extra of the benchmarks")
from benchmarks import work_precision, work_precision_rivals as rivals, work_precision_ways as ways


@pytest.mark.parametrize("name", rivals.SYSTEMS)
def test_the_equations_in_c_are_those_of_the_scene(name):
    # fails if a sign or a parameter differs between C and the scene, or an order is lost
    setup = ways.SETUPS[name]
    start = ways.starts_of(setup.scene, 3, 5)
    truth = ways.exact_motion(setup, start)
    y = torch.cat([start.q, setup.scene.velocity(*start)], -1)
    library = rivals.Native(name, "float64", dof=setup.scene.dof)

    def error(method, x):
        q, _ = rivals.Motions(library, y, setup.T, ways.CHECKS, method, x).made()
        return float((q - truth).abs().max())

    assert error("RK4", 4000) < 1e-7
    assert error("DOP853", 1e-9) < 1e-6
    if name == "damped_pendulum":
        assert abs(math.log2(error("leapfrog", 512) / error("leapfrog", 1024)) - 2) < 0.2


def test_dop853_in_c_is_dop853():
    # fails if a coefficient is lost on the way into C: the error must follow the tolerance, at order 8's price
    library = rivals.Native("damped_pendulum", "float64", fast=False)
    y = torch.tensor([[1.5, 0.3]], dtype=torch.float64)
    exact, _ = rivals.Motions(library, y, 8.0, 4, "RK4", 4000).made()
    errors, counts = [], []
    for tol in (1e-4, 1e-7, 1e-10):
        q, count = rivals.Motions(library, y, 8.0, 4, "DOP853", tol).made()
        errors.append(float((q - exact).abs().max()))
        counts.append(count)
    assert [e < 10 * tol for e, tol in zip(errors, (1e-4, 1e-7, 1e-10), strict=True)] == [True] * 3, errors
    assert counts[2] < 5 * counts[0]  # six decades: 10^(6/8) = 5.6 times the steps, less what the shortest need
    fixed = [
        float((rivals.Motions(library, y, 8.0, 4, "DOP853 fixed", x).made()[0] - exact).abs().max()) for x in (2, 4)
    ]
    assert math.log2(fixed[0] / fixed[1]) > 7.5


@pytest.mark.parametrize("layers", [1, 2])
def test_a_network_in_c_is_the_network(layers):
    # fails if a weight is read transposed, a bias is dropped, or the quotient for tanh is not tanh
    make = torch.Generator().manual_seed(0)
    width, n = 6, 2
    sizes = [(3 * n, width), (width,), *([(width, width), (width,)] if layers == 2 else []), (n, width)]
    w = [torch.randn(s, generator=make, dtype=torch.float64) for s in sizes]
    weights = rivals.Weights(torch.cat([x.flatten() for x in w]), n, width, layers)
    library = rivals.Native("double_pendulum", "float64", weights, n)
    y = torch.randn(5, 2 * n, generator=make, dtype=torch.float64)

    def rhs(y):
        q, v = y[..., :n], y[..., n:]
        x = torch.tanh(torch.cat([q.sin(), q.cos(), v], -1) @ w[0] + w[1])
        x = torch.tanh(x @ w[2] + w[3]) if layers == 2 else x
        return torch.cat([v, x @ w[-1].T], -1)

    h = 0.1
    k1 = rhs(y)
    k2 = rhs(y + h / 2 * k1)
    k3 = rhs(y + h / 2 * k2)
    wanted = y + h / 6 * (k1 + 2 * (k2 + k3) + rhs(y + h * k3))
    q, count = rivals.Motions(library, y, h, 1, "RK4", 1).made()
    assert count == 20
    assert float((q[:, 0] - wanted[:, :n]).abs().max()) < 1e-6


def test_a_setting_is_chosen_on_other_starts_than_it_is_judged_on():
    # fails if the judging half chooses, a rival of another seed is taken, or the classical ones are lost
    def point(kind, us, choice, error, **more):
        return {"kind": kind, "setting": f"{us}", "us_per_time": us, "choice_median": choice, "median": error, **more}

    points = [point("learned kicks", 1.0, 2e-3, 1e-5, seed=0), point("learned kicks", 2.0, 5e-4, 3e-3, seed=0),
              point("learned kicks", 4.0, 5e-4, 1e-4, seed=1), point("neural ODE, RK4", 20.0, 0.0, 1e-3, seed=0),
              point("neural ODE, RK4", 10.0, 0.0, 1e-5, seed=1),
              point("DOP853, true equations", 8.0, 0.0, 1e-6)]  # fmt: skip
    rows = work_precision.chosen(points, "median", 1e-3, 2)["seeds"]
    assert [(r["us_per_time"], r["error"]) for r in rows] == [(2.0, 3e-3), (4.0, 1e-4)]
    assert [(r["neural ODE"], r["DOP853"], r["RK4"]) for r in rows] == [(10.0, 4.0, None), (2.5, 2.0, None)]
    q = torch.tensor([[[0.1]], [[0.2]], [[3.0]], [[3.0]]])
    found = ways.judged(q, torch.zeros_like(q))
    assert found["choice_q95"] == pytest.approx(0.2)
    assert found["median"] == pytest.approx(3.0)


def test_the_learned_equation_is_that_of_the_model():
    # fails if a learned number stands at another place of the C equation, or the entry's velocity is not M⁻¹p
    from herglotz.mechanics import legendre_plus
    from herglotz.models import ContactLagrangian, ModelConfig
    from herglotz.stepping import State, Stepper

    features, ones, none = ("pendulums", "cos(q1)", "cos(q2)"), (1.0, 1.0), (0.0, 0.0)
    config = ModelConfig(
        angles=(True, True), scale=ones, speed=ones, stiffness=none, tilt=none, features=features, potential_width=0
    )
    model = ContactLagrangian(config).double()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("coefficient") or name == "damping.rate":
                parameter.copy_(torch.arange(1.0, 1.0 + parameter.numel()).reshape(parameter.shape) / 5)
    found = rivals.constants_of(model)
    q, v = torch.tensor([[0.3, -0.4]]).double(), torch.tensor([[0.7, 0.2]]).double()
    start = State(q, torch.zeros_like(q), torch.zeros(1).double())
    h = 1e-5  # p = ∂K/∂v from the model itself, by the step of a motion with this velocity
    with torch.no_grad():
        p = legendre_plus(model, q - h * v, q, torch.zeros(1).double(), h)[1]
        out = Stepper(model).rollout(q, p, h=1e-3, steps=100)
    start = State(q, p, torch.zeros(1).double())
    torch.testing.assert_close(rivals._velocity(found, start), v, rtol=1e-3, atol=1e-3)
    library = rivals.Native("double_pendulum", "float64", dof=2, constants=found)
    wanted, _ = rivals.Motions(library, torch.cat([q, v], -1), 0.1, 1, "RK4", 100).made()
    torch.testing.assert_close(out.q[:, -1], wanted[:, 0], rtol=0, atol=1e-4)
    plain = rivals.Native("double_pendulum", "float64", dof=2)
    other, _ = rivals.Motions(plain, torch.cat([q, v], -1), 0.1, 1, "RK4", 100).made()
    assert float((other - wanted).abs().max()) > 1e-3


def test_the_page_holds_what_the_results_hold():
    # fails if results are stored anew and `work_precision.py --page` is not run, or a number is typed in
    assert work_precision.PAGE.read_text() == work_precision.page(), "run python benchmarks/work_precision.py --page"


def test_what_a_term_costs_is_against_the_scenes_own():
    # fails if a ratio is turned over, or another scene's model is compared with
    def point(kind, us, error, **more):
        return {"kind": kind, "setting": kind[9:] + ", h 0.5, C float64", "us_per_time": us, "median": error, "h": 0.5,
                "dtype": "float64", "artefact": "C", **more}  # fmt: skip

    own = {"setting": "own model"}
    scenes = {
        "kepler": [point("learned", 4.0, 1e-3, **own), point("learned, level conservative", 2.0, 0.1),
                   point("learned, no correction", 1.0, None)],
        "chain": [point("learned", 8.0, 1e-2, **own), point("learned, level conservative", 4.0, 0.1)],
    }  # fmt: skip
    rows = [[x.strip() for x in line.split("|")[1:-1]] for line in work_precision.terms(scenes)[2:]]
    assert [row[1] for row in rows if not row[0]] == ["no damping", "no correction", "no damping"]
    assert [row[2:] for row in rows] == [["2", "0.001", ""], ["1", "0.1", "0.5, 1e+02"], ["0.5", "fails", "0.25, –"],
                                         ["4", "0.01", ""], ["2", "0.1", "0.5, 10"]]  # fmt: skip
