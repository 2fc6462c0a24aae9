"""Vector–Jacobian products in C against autograd through the eager stepper, over one step and over a rollout."""

import re

import pytest
import torch
from test_c_parameters import CASES, H, address, join, named, problem

from herglotz.codegen.c_compiler import build
from herglotz.export.c_header import c_source, described
from herglotz.export.metadata import describe
from herglotz.export.parameters import described_parameters
from herglotz.models.numbers import WithNumbers, values_of, with_values
from herglotz.stepping import State, Stepper
from tests.compilers import needs_compiler

pytestmark = needs_compiler
STEPS = 4
LOOPS = """
#include "stepper.h"
int rollout(const double *theta, const double *u, double *q, double *p, double *s, const double *of_q,
            const double *of_p, const double *of_s, double *by_state, double *by_input, double *by_theta,
            double *by_h) {
  arm_state x;
  arm_parameters values;
  int i, status;
  for (i = 0; i < arm_N; i++) {
    x.q[i] = q[i];
    x.p[i] = p[i];
  }
  x.s = s[0];
  x.sigma = 1.0;
  for (i = 0; i < arm_P; i++) values.value[i] = theta[i];
  (void)u;
  (void)by_input;
  status = arm_rollout(&x, 0.1, WITH_U(u) &values, STEPS, 1, q, p, s);
  if (status) return status;
  return arm_rollout_vjp(0.1, WITH_U(u) &values, STEPS, q, p, s, of_q, of_p, of_s, by_state, WITH_U(by_input) by_theta,
                         by_h);
}
"""


QUICK = ("conservative", "affine", "viscous, motors")  # the others take 5 to 15 s each


def library_of(model, names):
    """The header's functions without those that this page does not test, and the loop above."""
    loops = re.sub(r"WITH_U\((\w+)\)", r"\1," if model.inputs else "", LOOPS).replace("STEPS", str(STEPS))
    extra = {"h_range": None, "parameters": described_parameters(model, names), "extras": ["adjoint"]}
    entries = described(model, describe(model, H, None, (), 30, extra), "arm", "float64", None)
    return build(c_source(model, entries, "stepper.h", derivatives=False), loops)


@pytest.mark.parametrize("case", [pytest.param(x, marks=[] if x in QUICK else pytest.mark.slow) for x in CASES])
def test_the_adjoint_of_a_rollout_is_that_of_autograd(case):
    # fails if a transpose is forgotten, a state's own derivative is added twice or not, λ has the wrong sign, an input
    # gets the derivative of another step, or a number that acts through the map of the inputs is left out
    model, states, u = problem(case, STEPS)
    names, n = named(model), model.dof
    library = library_of(model, names)
    values = {name: x + 0.01 for name, x in zip(names, values_of(model, names), strict=True)}
    theta = torch.tensor(list(values.values()), dtype=torch.float64)
    make = torch.Generator().manual_seed(2)
    of = torch.randn(STEPS + 1, 2 * n + 1, generator=make, dtype=torch.float64)

    other = with_values(model, values)

    def cost(start, h, u, theta):
        def rolled():
            state, total = State(start[:n], start[n:-1], start[-1]), (start * of[0]).sum()
            for k in range(STEPS):
                step = Stepper(other, tol=4e-16).step(state, h, u=u[k] if model.inputs else None)
                state = step.state
                total = total + (torch.cat(join(state)) * of[k + 1]).sum()
            return total

        return WithNumbers(other, rolled, names).at(theta)

    start, h = torch.cat(join(State(*(x[0] for x in states)))), torch.tensor(H, dtype=torch.float64)
    driven = torch.zeros(STEPS, 0, dtype=torch.float64) if u is None else u[0].contiguous()
    arguments = [x.clone().requires_grad_() for x in (start, h, driven, theta)]
    wanted = torch.autograd.grad(cost(*arguments), arguments, allow_unused=True)

    q, p, s = (torch.zeros(STEPS + 1, size, dtype=torch.float64) for size in (n, n, 1))
    q[0], p[0], s[0] = start[:n], start[n:-1], start[-1:]
    found = [torch.full_like(x, torch.nan) for x in (start, driven, theta, h[None])]
    parts = (of[:, :n].contiguous(), of[:, n:-1].contiguous(), of[:, -1].contiguous())
    status = library.rollout(*map(address, (theta, driven, q, p, s, *parts, *found)))
    assert status == 0
    by_state, by_input, by_theta, by_h = found
    for ours, theirs in zip((by_state, by_h[0], by_input, by_theta), wanted, strict=True):
        if theirs is not None and theirs.numel():
            assert (ours - theirs).abs().max() <= 1e-10 * theirs.abs().max()


def test_an_adjoint_of_what_is_not_finite_is_a_status():
    # fails if NaN in a kept state, or in the derivatives, leaves as numbers
    model, states, _ = problem("conservative", STEPS)
    names = named(model)
    library = library_of(model, names)
    theta = torch.tensor(values_of(model, names), dtype=torch.float64)
    q, p, s = (torch.zeros(STEPS + 1, dtype=torch.float64) for _ in range(3))
    q[0], p[0] = states.q[0, 0], states.p[0, 0]
    for at, status in ((0, 3), (STEPS, 3), (None, 0)):
        of = torch.ones(STEPS + 1, dtype=torch.float64)
        if at is not None:
            of[at] = torch.nan
        by = torch.zeros(3, dtype=torch.float64)
        found = library.rollout(*map(address, (theta, None, q, p, s, of, None, None, by, None, None, None)))
        assert found == status, at
