"""The compiled kernel of fits: the motions, derivatives and normal equations of eager torch, in pieces or at once."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Stepper, state_of
from herglotz.training import flow
from herglotz.training.arrowhead import Sums
from herglotz.training.cross_validation import _left_out, data_rows
from herglotz.training.dictionary import dictionary, keys_of
from herglotz.training.flow import motion
from herglotz.training.held_out import RIDGE
from herglotz.training.kernel import kernel_of
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.waves import waves_of
from tests.compared import dense

PENDULUM = ModelConfig(angles=(True,), level="forced", stiffness=(0.0,), alike=True, potential_width=0, damping_width=0,
                       features=("cos(q1)", "sin(2q1)"), drag=("|v1| v1",))  # fmt: skip
SPRING = replace(PENDULUM, angles=(False,), features=("q1^2", "q1^3", "|q1| q1"), drag=("q1^2 v1",), inputs=1,
                 input_zero=True, coulomb=True, speed=(2.0,))  # fmt: skip
JOINTS = ModelConfig(angles=(True, True), level="forced", scale=(1.0, 1.0), speed=(1.0, 1.5), stiffness=(3.0, 2.0),
                     tilt=(0.1, 0.0), potential_width=0, damping_width=0, coupled=True, coulomb=True,
                     features=("cos(q1 - q2) v1 v2", "sin(q2) v1 v1"))  # fmt: skip
LENGTHS = replace(JOINTS, angles=(False, False), coupled=False, diagonal=True)
NETWORK = ModelConfig(angles=(True,), scale=(0.7,), speed=(1.7,), stiffness=(2.0,), tilt=(0.1,), potential_width=4)


def waves(*, middle, half, speed):
    """A model of one length with some of the waves of all functions over this interval, and a power."""
    found = waves_of((False,), lambda _: (middle, half), [speed], plane=False)
    own = {name: [text for text, _ in some] for name, some in found.items()}
    features = (*own["V(q1)"][:20], *own["mass(q1)"][:3], "q1^4")
    drag = (*own["damping(q1)"][2:6], *own["friction(v1)"][:4])
    return replace(PENDULUM, angles=(False,), features=features, drag=drag)


MODELS = {
    "order 2": PENDULUM,
    "order 4": replace(PENDULUM, order=4),
    "one rate": replace(PENDULUM, level="linear", drag=()),
    "driven, dry": SPRING,
    "held": replace(SPRING, sticking=True),
    "joints": JOINTS,
    "joints without a number": replace(JOINTS, absent=("friction.viscous[0]", "coupling.viscous")),
    "joints apart": replace(JOINTS, coupled=False, diagonal=True, features=("cos(q1 - q2) v1 v2",)),
    "a slide and a joint": replace(JOINTS, angles=(False, True), features=("cos(q2) v1 v2", "q1^3"), drag=("q1 v1",)),
    "lengths": replace(LENGTHS, features=("(q1 - q2)^2", "r^-1"), drag=("(v1 - v2)", "|v| v")),
    "lengths in proportion": replace(
        LENGTHS, features=("(2.5 q1 - q2)^2", "(2.5 q1 + q2)^3", "q1^3"), drag=("(2.5 v1 - v2)", "|v1| v1")
    ),
    "joints with a geared damper": replace(JOINTS, drag=("(2.5 v1 - v2)",)),
    "own structure": replace(PENDULUM, alike=False, stiffness=(1.0,)),
    "waves of one length": waves(middle=0.3, half=1.7, speed=2.0),
    "waves of several kinds": replace(
        JOINTS,
        angles=(False, False),
        features=("cos(0.7 q1 - 1.4 q2)", "sin(2.1 q1)", "cos(2.8 q2)", "cos(1.5 q1 + 0.3) v1 v2", "cos(3 q1)", "q1^3"),
        coupled=False,
        drag=("cos(1.9 q2) v1", "sin(0.8 v1)", "cos(1.3 (v1 - v2))", "sin(2.6 (v1 - v2))", "cos(2.2 q1) sgn(v2)"),
    ),
    "network": replace(NETWORK, level="forced"),
    "network, driven": replace(NETWORK, level="forced", inputs=1, input_zero=True),
    "conservative": replace(NETWORK, level="conservative"),
    "affine": replace(NETWORK, level="affine", damping_width=3),
    "full": replace(NETWORK, level="full", damping_width=3, action_width=2),
    "correction": replace(NETWORK, level="linear", correction_width=3),
    "powers of s": replace(PENDULUM, dissipation=("s^3", "s^2")),
    "powers of s of joints": replace(JOINTS, dissipation=("s^2",)),
    "networks of joints": replace(
        JOINTS, features=(), scale=(0.7, 1.3), potential_width=4, mass_width=3, coupled=False, coulomb=False
    ),
    "affine, two lengths": replace(
        NETWORK, angles=(False, False), scale=(0.7, 1.3), speed=(1.1, 2.0), stiffness=(2.0, 1.0), tilt=(0.0, 0.1),
        level="affine", damping_width=3,
    ),
}  # fmt: skip


def problem_of(config, *, length=5, freedom=None, samples=24):
    """A problem over segments of `length` steps, and unknowns near a motion of the model."""
    model, n = ContactLagrangian(config), config.dof
    make = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, value in model.named_parameters():
            if "log" not in name:
                value.add_(0.1 * torch.rand(value.shape, generator=make, dtype=torch.float64))
        ParameterVector(model).set(ParameterVector(model).get())  # absent numbers are 0 again
    t = torch.linspace(0, 1.5, samples, dtype=torch.float64)
    q = torch.stack([torch.cos(2 * t + i) * (0.8 + 0.2 * i) for i in range(n)], -1)
    u = torch.sin(5 * t)[:, None].repeat(1, config.inputs) if config.inputs else None
    data = Trajectories.cat([Trajectories.of(t, by * q, angles=config.angles, u=u) for by in (1.0, 0.7)])
    grid = segment_grid(data, length, 0.04)
    problem = ShootingProblem(model, data, grid, sigma=0.05, freedom=freedom)
    at = data.q[grid.start_sample]
    states = problem.states(at, 0.3 - at, 0.1 * at[:, 0])
    return problem, problem.pack(problem.parameters.get(), states)


def slopes(problem, x):
    assert problem.path is not None
    return problem.slopes_at_samples(x[: problem.P], problem.path)


def kernel(config):
    placed = kernel_of(ContactLagrangian(config))
    assert placed is not None
    return placed.kernel


def eager(config, **settings):
    problem, x = problem_of(config, **settings)
    problem.compiled = None
    return problem, x


# Robust weights multiply the rows of any model.
@pytest.mark.parametrize(
    ("name", "freedom"), [*((name, None) for name in MODELS), ("joints", 4.0), ("held", 4.0), ("full", 4.0)]
)
def test_compiled_equations_are_those_of_torch(name, freedom):
    # fails if a derivative, a robust weight, a joint or the place of a number in the kernel is wrong
    problem, x = problem_of(MODELS[name], freedom=freedom)
    assert problem.compiled is not None
    other, _ = eager(MODELS[name], freedom=freedom)
    mine, its = problem.normal_equations(x), other.normal_equations(x)
    assert float(mine[0]) == pytest.approx(float(its[0]), rel=1e-10)
    for a, b in ((dense(mine[1]), dense(its[1])), (mine[2], its[2])):
        assert float((a - b).abs().max()) <= 1e-10 * float(b.abs().max())
    assert float(problem.cost(x)) == pytest.approx(float(mine[0]), rel=1e-13)
    rows, own = slopes(other, x), slopes(problem, x)
    assert float((rows - own).abs().max()) <= 1e-10 * float(rows.abs().max())


@pytest.mark.usefixtures("optimised_c")
def test_the_optimised_kernel_has_the_same_equations():
    # fails if the compiler's optimisation, which other tests leave out, changes more than roundings
    test_compiled_equations_are_those_of_torch("joints", None)


@pytest.mark.parametrize("length", [5, 23])
def test_pieces_add_up_to_the_whole(length, monkeypatch):
    # fails if a segment that is cut into pieces loses a sample, its state or its derivatives
    problem, x = problem_of(MODELS["joints"], length=length)
    assert problem.compiled is not None
    whole = problem.normal_equations(x)
    monkeypatch.setattr(flow, "CHUNK_BYTES", 8 * 2 * 40 * 7)  # seven samples at most
    problem.compiled.jobs.clear()
    pieces = problem.normal_equations(x)
    theta, starts = problem.unpack(x)
    sums = Sums.zeros(problem.P, problem.grid.segments, problem.d, x)
    one, other = (problem.compiled.run(theta, problem.with_s(starts), problem._observed(), of) for of in (sums, None))
    assert one is not None
    assert other is not None
    # Fused multiply-adds round the end of a step in another way where its derivatives are made beside it.
    assert float((one - other).abs().max()) <= 1e-14 * float(other.abs().max())
    assert float((dense(whole[1]) - dense(pieces[1])).abs().max()) <= 1e-12 * float(dense(whole[1]).abs().max())
    assert float((whole[2] - pieces[2]).abs().max()) <= 1e-12 * float(whole[2].abs().max())


def test_equations_are_solved_by_blocks():
    # fails if elimination of the states is not that of the whole matrix
    problem, x = problem_of(MODELS["order 2"])
    _, A, b = problem.normal_equations(x)
    damping = 1e-3 * A.diagonal()
    expected = torch.linalg.solve(dense(A) + torch.diag(damping), b)
    found = A.solve(b, damping)
    assert found is not None
    assert float((found - expected).abs().max()) <= 1e-8 * float(expected.abs().max())
    assert float((A @ b - dense(A) @ b).abs().max()) <= 1e-12 * float((dense(A) @ b).abs().max())


@pytest.mark.parametrize(("length", "segments"), [(6, (0, 3)), (6, (1, 2)), (10**3, (0,))])
def test_other_states_are_eliminated(length, segments):
    # fails if a state that stays loses its coupling to a neighbour, or the information of a state that goes is lost
    problem, x = problem_of(MODELS["order 2"], length=length)
    A, P, d = problem.normal_equations(x)[1], problem.P, problem.d
    whole = dense(A)
    stay = torch.cat([torch.arange(P), *(P + d * k + torch.arange(d) for k in segments)])
    gone = torch.ones(len(whole), dtype=torch.bool)
    gone[stay] = False
    solved = torch.linalg.solve(whole[gone][:, gone], whole[gone][:, stay])
    expected = whole[stay][:, stay] - whole[stay][:, gone] @ solved
    found = A.onto(segments)
    assert found is not None
    assert float((found - expected).abs().max()) <= 1e-8 * float(expected.abs().max())
    assert replace(A, corner=A.corner / 0).onto(segments) is None


def test_a_fold_is_left_out_of_joined_segments():
    # fails if segments that lie inside a fold are not carried through it by their joints
    problem, x = problem_of(MODELS["order 2"], length=3)
    _, A, _ = problem.normal_equations(x)
    theta, segment, P, d = problem.unpack(x)[0], problem.grid.segment, problem.P, problem.d
    assert problem.path is not None
    r, own = data_rows(problem, problem.path, theta)
    J = own.new_zeros(len(r), P + d * problem.grid.segments)
    J[:, :P] = own[:, 0, :P]
    for i in range(d):
        J[torch.arange(len(r)), P + d * segment + i] = own[:, 0, P + i]
    fold = ((segment > 2) & (segment < 5))[:, None]
    rows = fold[:, 0]
    rest = dense(A) - J[rows].T @ J[rows] + RIDGE * torch.diag(A.diagonal())
    expected = r[fold] + J[rows] @ torch.linalg.solve(rest, J[rows].T @ r[fold])
    torch.testing.assert_close(_left_out(A, own, r, segment, fold), expected, rtol=1e-4, atol=0)


def test_a_motion_that_has_no_step_costs_infinity():
    # fails if a step without a solution gives numbers
    problem, x = problem_of(MODELS["order 4"])
    x[: problem.P] = 1e200
    assert float(problem.cost(x)) == float("inf")
    assert not bool(torch.isfinite(problem.normal_equations(x)[0]))


@pytest.mark.parametrize("name", ["network", "joints", "held"])
def test_a_motion_that_is_not_a_number_costs_infinity(name):
    # fails if Newton's iteration takes a move that is NaN for one of size 0, and NaN for a solution
    problem, x = problem_of(MODELS[name])
    for at in problem.places(0)[problem.P :]:  # q and p of each coordinate
        lost = x.clone()
        lost[at] = float("nan")
        assert problem.solve(lost) is None
        assert float(problem.cost(lost)) == float("inf")


def test_one_kernel_serves_every_subset_of_its_terms():
    # fails if a model of fewer terms is compiled again: a search would take seconds for each
    fewer = replace(JOINTS, features=(), coulomb=False)
    assert len({kernel(config) for config in (JOINTS, MODELS["joints without a number"], fewer)}) == 1
    assert kernel(PENDULUM) is kernel(MODELS["one rate"])


def test_terms_that_are_absent_cost_nothing_and_say_nothing():
    # fails if what only absent terms need is computed: θ⁶ of a motion far out is infinite, and 0 · ∞ is no number
    problem, x = problem_of(replace(SPRING, features=("q1^2",), drag=(), coulomb=False, inputs=0, input_zero=False))
    assert problem.compiled is not None
    assert "q1^6" in problem.compiled.kernel.place
    x[problem.P :] *= 1e60
    assert bool(torch.isfinite(problem.cost(x)))
    _, A, b = problem.normal_equations(x)
    assert bool(torch.isfinite(dense(A)).all() and torch.isfinite(b).all())


def test_a_number_that_is_0_and_is_fitted_has_its_derivative():
    # fails if a parameter is taken for absent because it is 0
    problem, x = problem_of(PENDULUM)
    x[: problem.P] = 0.0
    problem.normal_equations(x)
    other, _ = eager(PENDULUM)
    other.normal_equations(x)
    its = slopes(other, x)
    assert float((slopes(problem, x) - its).abs().max()) <= 1e-10 * float(its.abs().max())
    assert float(its[..., : problem.P].abs().amax((0, 1)).min()) > 0


def test_numbers_go_by_their_terms():
    # fails if a coefficient is found by its place: subsets have other places
    whole = dictionary(PENDULUM)
    assert whole is not None
    fewer = replace(PENDULUM, features=("sin(2q1)",))
    assert set(keys_of(ParameterVector(ContactLagrangian(fewer)).numbers, fewer)) == {
        "sin(2q1)", "damping.rate", "friction.viscous", "|v1| v1",
    }  # fmt: skip


def test_one_kernel_serves_functions_over_every_interval():
    # fails if a rate or a phase is a constant of the kernel: every recording would then wait for the compiler
    one, other = MODELS["waves of one length"], waves(middle=-2.0, half=0.31, speed=9.0)
    few = replace(other, features=other.features[4:9], drag=other.drag[1:3])
    assert kernel(one) is kernel(other) is kernel(few)
    problem, x = problem_of(few)
    its, _ = eager(few)
    assert float(problem.cost(x)) == pytest.approx(float(its.cost(x)), rel=1e-12)


def test_what_no_kernel_holds_has_none():
    # fails if a large network is compiled into lines without end, or a kernel is given numbers of another precision
    assert kernel_of(ContactLagrangian(replace(PENDULUM, potential_width=96))) is None
    assert kernel_of(ContactLagrangian(PENDULUM).float()) is None


def test_without_a_compiler_torch_fits(monkeypatch):
    # fails if a machine without a compiler cannot fit
    monkeypatch.setenv("CC", "no-such-compiler")
    problem, x = problem_of(MODELS["order 2"])
    assert problem.compiled is None
    assert bool(torch.isfinite(problem.normal_equations(x)[0]))


def test_threads_add_up_to_the_same(monkeypatch):
    # fails if jobs share what they write, leave a segment out, or if the number of processors decides a sum
    problem, x = problem_of(MODELS["joints"])
    whole = problem.normal_equations(x)
    monkeypatch.setattr(flow, "SAMPLES_PER_JOB", 7)
    found = []
    for processors in (1, 4):
        monkeypatch.setattr(flow.os, "cpu_count", lambda count=processors: count)
        other, _ = problem_of(MODELS["joints"])
        assert other.compiled is not None
        found.append(other.normal_equations(x))
        assert all(len(jobs) > 2 for jobs in other.compiled.jobs.values())
    one, several = ((dense(A), b) for _, A, b in found)
    assert all(torch.equal(*pair) for pair in zip(one, several, strict=True))
    assert float((one[0] - dense(whole[1])).abs().max()) <= 1e-12 * float(one[0].abs().max())
    assert float((one[1] - whole[2]).abs().max()) <= 1e-12 * float(whole[2].abs().max())


@pytest.mark.parametrize("name", ["driven, dry", "held", "joints"])
def test_motions_are_the_steppers(name):
    # fails if a free run by the kernel has another step, input, s or order of its segments
    problem, _ = problem_of(MODELS[name])
    model, make = problem.parameters.model, torch.Generator().manual_seed(1)
    start = 0.3 * torch.randn(3, 2 * model.dof + 1, generator=make, dtype=torch.float64)
    h = torch.full((3, 12), 0.05, dtype=torch.float64)
    u = torch.randn(3, 12, model.inputs, generator=make, dtype=torch.float64) if model.inputs else None
    found = motion(model, start, h, u)
    assert found is not None
    with torch.no_grad():
        stepped = Stepper(model).rollout(*state_of(start), h=h, inputs=u).states.joined
    assert float((found - stepped).abs().max()) <= 1e-10
    assert motion(model, start * float("nan"), h, u) is None
