"""The steps that `benchmarks/control.py` compares are one step."""

import numpy as np
import pytest
import torch

from herglotz.stepping import State, Stepper

pytest.importorskip("casadi", reason="the extra `control` is not installed")
from benchmarks.control import H, model, sx_steps


def test_the_same_step_in_casadi_is_that_of_the_model():
    # fails if what is timed beside ours is another function: a term is left out, or a derivative by hand is wrong
    draw = np.random.default_rng(0)
    x = np.column_stack([draw.uniform(-0.5, 0.5, 20), draw.uniform(-3, 3, 20), draw.normal(size=(20, 4))])
    q, p, s, u = (torch.tensor(x[:, cut]) for cut in (slice(0, 2), slice(2, 4), 4, slice(5, 6)))
    with torch.no_grad():
        there = Stepper(model(), tol=1e-15).step(State(q, p, s), H, u=u).state
    ours = torch.cat([there.q, there.p, there.s[:, None]], 1).numpy()
    forms = {name: np.array([np.array(of(row[:5], row[5], H)).ravel() for row in x]) for name, of in sx_steps().items()}
    for name, found in forms.items():
        assert abs(found - ours).max() <= 1e-12, name
