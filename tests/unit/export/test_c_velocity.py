"""NAME_init_qv and NAME_velocity beyond what test_every_term.py has: statuses, float, and headers without them."""

import ctypes
import math
from typing import Any

import pytest
import torch
from export_models import model_of, states_of, with_terms

from herglotz.codegen.c_compiler import build
from herglotz.errors import InputError
from herglotz.export import compile_c
from herglotz.export.c_header import c_source, described
from herglotz.export.load import compiled
from herglotz.export.metadata import describe
from herglotz.export.parameters import described_parameters
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, StepError, Stepper
from tests.compilers import needs_compiler

pytestmark = needs_compiler
NAN = math.nan

CALLS = """
#include "stepper.h"
int start(double q, double v, double s, double h, double *p) {
  model_state x = {{7.0}, {7.0}, 7.0, 7.0};
  const int status = model_init_qv(&q, &v, s, h, &x);
  *p = x.p[0];
  return status;
}
int speed(double q, double p, double s, double h, double *v) {
  const model_state x = {{q}, {p}, s, 1.0};
  *v = 7.0;
  return model_velocity(&x, h, v);
}
"""


def header_of(model, dtype="float64", box=None, h_range=None, **options):
    entries = describe(model, 0.1, box, (), 30, {"h_range": h_range})
    return c_source(model, described(model, entries, "model", dtype, None), "stepper.h", **options)


def cubic():
    """K = v²/2 + v³/3, so p = v + v²."""
    one = (1.0,)
    model: Any = ContactLagrangian(ModelConfig((False,), "linear", one, one, one, (0.0,), potential_width=0,
                                          features=("v1^3",))).requires_grad_(False)  # fmt: skip
    model.kinetic.sum.coefficient.fill_(1 / 3)
    return model


def test_statuses_of_velocities():
    # fails if what is no number is taken, if `out` or v is written nevertheless, or a flag is lost
    box = {f"{x}_{end}": [sign * 2.0] for x in "qps" for end, sign in (("low", -1), ("high", 1))}
    library = build(header_of(model_of(1, "linear"), box=box, h_range=(0.05, 0.2)), CALLS)
    library.start.argtypes = library.speed.argtypes = [ctypes.c_double] * 4 + [ctypes.POINTER(ctypes.c_double)]
    found = ctypes.c_double()
    for call, bad in ((library.start, 5), (library.speed, 3)):
        assert call(0.5, 1.0, 0.0, 0.1, found) == 0
        assert found.value == pytest.approx(1.0, rel=1e-15)  # the mass is 1
        assert call(0.5, 3.0, 0.0, 0.3, found) == 48  # outside of the box and of the steps
        assert found.value == pytest.approx(3.0, rel=1e-15)
        for wrong in ((NAN, 1.0, 0.0), (0.5, math.inf, 0.0), (0.5, 1.0, NAN)):
            assert (call(*wrong, 0.1, found), found.value) == (bad, 7.0)
        for h in (0.0, -0.1, NAN):
            assert (call(0.5, 1.0, 0.0, h, found), found.value) == (5, 7.0)


def test_where_no_velocity_has_this_momentum():
    # fails if the last guess is taken for a velocity: K = v²/2 + v³/3 has p = v + v², which is nowhere below −1/4
    model = cubic()
    q, p, s = (
        torch.full((2, 1), 0.3, dtype=torch.float64),
        torch.tensor([[0.75], [-1.0]]).double(),
        torch.zeros(2).double(),
    )
    for stepper in (Stepper(model), compiled(header_of(model))):
        assert float(stepper.velocity(State(q[:1], p[:1], s[:1]), 0.1)) == pytest.approx(0.5, rel=1e-14)
        with pytest.raises(StepError, match=r"no velocity at sample \(1,\)"):
            stepper.velocity(State(q, p, s), 0.1)


OF_NUMBERS = """
#include "stepper.h"
int both(double value, double *out) {
  const double q[2] = {0.3, -0.2}, v[2] = {0.4, 0.1};
  model_state x = {{7.0, 7.0}, {7.0, 7.0}, 7.0, 7.0}, usual, null;
  model_parameters theta = model_defaults;
  double speed[2] = {7.0, 7.0};
  int status = model_init_qv(q, v, 0.0, 0.1, &model_defaults, &usual) | model_init_qv(q, v, 0.0, 0.1, 0, &null);
  theta.value[0] = value;
  status += model_init_qv(q, v, 0.0, 0.1, &theta, &x);
  status += 16 * model_velocity(status ? &usual : &x, 0.1, &theta, speed);
  out[0] = x.p[1];
  out[1] = speed[0];
  out[2] = usual.p[1];
  out[3] = null.p[1];
  return status;
}
"""


def test_numbers_out_of_bounds_have_no_velocity():
    # fails if numbers that are set at run time are not checked before p or v is made of them, are not used, or null is
    # not the defaults
    model = model_of(2, "linear")
    chosen = described_parameters(model, {"kinetic.log_diagonal": (-1.0, 1.0)})
    entries = describe(model, 0.1, None, (), 30, {"h_range": None, "parameters": chosen})
    library = build(c_source(model, described(model, entries, "model", "float64", None), "stepper.h"), OF_NUMBERS)
    out = (ctypes.c_double * 4)()
    for value, status in ((2.0, 5), (NAN, 5), (0.5, 0)):
        assert library.both(ctypes.c_double(value), out) == 17 * status
        assert ([*out[:2]] == [7.0, 7.0]) == bool(status)
    assert out[1] == pytest.approx(0.4, rel=1e-14)
    assert out[2] == out[3] != pytest.approx(out[0], rel=1e-3)


@pytest.mark.parametrize("case", ["sticking", "m(q), coupled"])
def test_velocities_in_float(case):
    # fails if 1/h² of the instant overflows a float, or the tolerance is out of its reach
    model = with_terms(case)
    q, v, s = states_of(model.dof, 5)
    eager, single = Stepper(model), compiled(header_of(model, "float32"))
    low = [x.float() for x in (q, v, s)]
    torch.testing.assert_close(single.init_qv(*low, h=0.1).p.double(), eager.init_qv(q, v, s, 0.1).p.detach(),
                               rtol=1e-5, atol=1e-6)  # fmt: skip
    back = single.velocity(single.init_qv(*low, h=0.1), 0.1)
    torch.testing.assert_close(back, low[1], rtol=1e-4, atol=1e-5)


def test_a_compiled_model_has_velocities_and_an_old_header_says_what_to_do():
    # fails if the quick header of compile_c is asked in vain, or a missing function ends the process
    model = model_of(2, "linear")
    state = states_of(2, 3)
    compiled_model = compile_c(model, h=0.1)
    torch.testing.assert_close(compiled_model.velocity(state, 0.1), Stepper(model).velocity(state, 0.1).detach())
    old = compiled(header_of(model, derivatives=False))
    with pytest.raises(InputError, match="without velocities; export the model again"):
        old.velocity(state, 0.1)


@pytest.mark.parametrize("case", ["sticking", "m(q), coupled", "cubic"])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_velocities_side_by_side_are_those_of_each_state(case, dtype):
    # fails if a register gives another velocity than a state alone, ends before Newton has, takes a state that is not
    # finite for one with a velocity, or lets it change its neighbours; 19 states: two registers and a part of one
    model = cubic() if case == "cubic" else with_terms(case)
    stepper = compiled(header_of(model, dtype))
    n, real = model.dof, getattr(torch, dtype)
    q, v, s = (x.contiguous() for x in states_of(n, 19, real))
    at = stepper.init_qv(q, 0.3 * v, s, h=0.1)
    p = at.p.clone()
    p[5] = NAN
    p[11] = -1e3 if case == "cubic" else p[11]  # no velocity has it
    states = torch.cat([q, p, s[:, None], torch.ones(19, 1, dtype=real)], 1)
    seen, status = torch.full((19, 2 * n), 7.0, dtype=real), torch.zeros(19, dtype=torch.int32)
    ends = torch.full((n,), -100.0, dtype=real), torch.full((n,), 100.0, dtype=real)
    library, h = stepper.loop, torch.full((1,), 0.1, dtype=real)
    library.holds(states, h, torch.zeros(19, max(1, model.inputs), dtype=real), 0, *ends, (seen, status))()
    alone, failed = library.velocity(q, p, s, h.expand(19).contiguous())
    assert status.tolist() == failed.tolist()
    good = status == 0
    assert (~good).nonzero().ravel().tolist() == [5, 11][: 1 + (case == "cubic")]
    eps = torch.finfo(real).eps  # differences are at most a quarter of it
    torch.testing.assert_close(seen[good, n:], alone[good], rtol=4 * eps, atol=4 * eps)
    assert (seen[~good, n:] == 7.0).all()
