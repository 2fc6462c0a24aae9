"""The controller of `examples/real_time_iteration` around a file for CasADi: what it converges to, and its bounds."""

import ctypes
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from export_models import damped

from herglotz.export import export_casadi
from herglotz.stepping import State, Stepper
from tests.compilers import CC, needs_compiler, run_compiler

pytestmark = needs_compiler
RTI = Path(__file__).parents[3] / "examples" / "real_time_iteration" / "rti.c"
FLAGS = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Werror", "-fPIC", "-shared")
N, NX, NU, H = 6, 3, 2, 0.2
double = ctypes.c_double


class Controller(ctypes.Structure):
    _fields_ = [
        ("H", double), ("X", double * NX), ("Q", double * NX), ("E", double * NX), ("R", double * NU),
        ("U", double * NU), ("B", double * NX), ("barrier", double), ("near", double),
        ("x", double * (NX * (N + 1))), ("u", double * (NU * N)), ("K", double * (NU * NX * N)),
        ("k", double * (NU * N)), ("damping", double), ("cost", double),
    ]  # fmt: skip


def controller(bounds, position=0.0):
    """Bounds of both inputs, and of the position."""
    it = Controller(H=H, barrier=20.0, near=0.5)
    it.B[0] = position
    it.X[:], it.Q[:], it.E[:] = (1.0, 0.0, 0.0), (1.0, 0.1, 0.0), (20.0, 1.0, 0.0)
    it.R[:], it.U[:] = (0.05, 0.02), bounds
    return it


def cost_of(model, x, u, it):
    """What the inputs u (N, 2) cost from x: two eager steps of 0.1 an interval."""
    total = 0.0
    state = State(*(torch.tensor(part, dtype=torch.float64) for part in (x[None, :1], x[None, 1:2], x[2:])))
    stepper = Stepper(model, tol=1e-15)
    for k in range(N + 1):
        now = torch.cat([state.q[0], state.p[0], state.s]).numpy()
        total += np.sum((it.Q if k < N else it.E) * (now - it.X) ** 2)
        if it.B[0]:
            for d in (1 - now[0] / it.B[0], 1 + now[0] / it.B[0]):
                beyond = ((d - 2 * it.near) / it.near) ** 2 / 2 - 0.5 - np.log(it.near)
                total += it.barrier * (-np.log(d) if d > it.near else beyond)
        if k < N:
            total += np.sum(np.array(it.R) * u[k] ** 2)
            for _ in range(2):
                with torch.no_grad():
                    state = stepper.step(state, 0.1, u=torch.tensor(u[k])[None]).state
    return total


@pytest.fixture(scope="module")
def model():
    """Two inputs on one coordinate, of different strength."""
    made = damped("forced", torch.float64, inputs=2)
    with torch.no_grad():
        made.get_parameter("friction.input_map").copy_(torch.tensor([[1.0, 0.6]]))
    return made


@pytest.fixture(scope="module")
def own(model, tmp_path_factory):
    """The controller of the model."""
    folder = tmp_path_factory.mktemp("rti")
    export_casadi(model, folder / "model.c", h=0.1, name="model")
    library = folder / "rti.so"
    command = [str(CC), *FLAGS, f"-DRTI_N={N}", f"-I{folder}", str(RTI), "-o", str(library), "-lm"]
    built = run_compiler(command)
    assert built.returncode == 0, built.stderr[:2000]
    return ctypes.CDLL(str(library))


BOUNDS = {"free": ((50.0, 50.0), 0.0), "inputs": ((0.7, 0.5), 0.0), "position": ((50.0, 50.0), 0.38)}


@pytest.mark.parametrize(("bounds", "position"), BOUNDS.values(), ids=BOUNDS)
def test_it_ends_where_no_input_within_the_bounds_costs_less(own, model, bounds, position):
    # fails if a block is transposed, the recursion forgets the cross term, a bound is left, an input that rests on a
    # bound takes part in the law, two inputs are solved as if one did not act on the other, the barrier's slope is not
    # that of its value, on either side or beyond the bound, where the motion starts, or an end that no
    # iteration betters is taken for a failure, which damps the next ones
    it = controller(bounds, position)
    x, first = np.array([-0.4, 0.3, 0.1]), (double * NU)()
    given = (double * NX)(*x)
    assert own.rti_feedback(ctypes.byref(it), given, first) == 0  # the first motion
    costs = [it.cost]
    for _ in range(25):
        assert own.rti_prepare(ctypes.byref(it)) == 0
        assert own.rti_feedback(ctypes.byref(it), given, first) == 0
        costs.append(it.cost)
    assert all(b <= a * (1 + 1e-12) for a, b in pairwise(costs))
    u, limit = np.array(it.u).reshape(N, NU), np.array(bounds)
    assert list(first) == u[0].tolist()
    assert (abs(u) <= limit).all()
    assert it.cost == pytest.approx(cost_of(model, x, u, it), rel=1e-10)
    assert it.damping < 1e-3
    q = np.array(it.x).reshape(N + 1, NX)[:, 0]
    assert (abs(q[1:]).max() <= 0.38) == bool(position)  # without the bound it goes farther
    assert abs(q[0]) > 0.38
    resting = abs(u) == limit
    assert resting.any() == (bounds[0] < 1)
    for k, j in np.ndindex(N, NU):  # the slope of the cost is 0 inside, and points outward at a bound
        ends = []
        for sign in (1, -1):
            moved = u.copy()
            moved[k, j] += sign * 1e-5
            ends.append(cost_of(model, x, moved, it))
        slope = (ends[0] - ends[1]) / 2e-5
        if resting[k, j]:
            assert slope * np.sign(u[k, j]) < 1e-6
        else:
            assert abs(slope) < 1e-4 * it.cost, (k, j)
    own.rti_shift(ctypes.byref(it))
    assert np.array(it.u).reshape(N, NU)[:-1].tolist() == u[1:].tolist()


def test_a_sharp_barrier_keeps_every_plan_within_the_bounds(own):
    # fails if an iteration takes a plan farther beyond the bound than `near` of it, though the barrier weighs little:
    # one that goes on as a parabola from half of the way is left
    farthest = {}
    for near in (1e-3, 0.5):
        it, first, given = controller((50.0, 50.0), 0.38), (double * NU)(), (double * NX)(-0.2, 0.0, 0.0)
        it.barrier, it.near, plans = 0.05, near, []
        assert own.rti_feedback(ctypes.byref(it), given, first) == 0
        for _ in range(25):
            assert own.rti_prepare(ctypes.byref(it)) == 0
            assert own.rti_feedback(ctypes.byref(it), given, first) == 0
            plans.append(abs(np.array(it.x).reshape(N + 1, NX)[:, 0]).max())
        farthest[near] = max(plans)
    assert 0.37 <= farthest[1e-3] <= 0.38 * (1 + 1e-3)
    assert farthest[0.5] > 0.4


def test_a_state_without_a_motion_is_an_error(own):
    # fails if a measurement that is no number gives an input without a word
    it, first = controller((1.0, 1.0)), (double * NU)()
    assert own.rti_feedback(ctypes.byref(it), (double * NX)(float("nan"), 0.0, 0.0), first) == 1
    it.H = -1.0
    assert own.rti_feedback(ctypes.byref(it), (double * NX)(), first) == 1
