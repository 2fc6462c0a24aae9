"""The contact splitting beside the step that its discrete Lagrangian generates."""

import torch

from herglotz.stepping import State, Stepper
from herglotz.theory import ContactSplitting


def test_the_step_is_that_of_its_discrete_lagrangian():
    # fails if a half step of damping leaves p as it was, or s is added up from another momentum
    make = torch.Generator().manual_seed(0)
    q, p = (torch.randn(5, 2, generator=make, dtype=torch.float64) for _ in range(2))
    state = State(q, p, torch.randn(5, generator=make, dtype=torch.float64))
    method = ContactSplitting(lambda q: (q**4).sum(-1) / 4 + q[..., 0] * q[..., 1], 1.3, 0.4)
    made, expected = method.step(state, 0.1), Stepper(method.L_d).step(state, 0.1)
    for own, other in zip((*made.state, made.c), (*expected.state, expected.c), strict=True):
        torch.testing.assert_close(own, other, rtol=0, atol=1e-11)
