"""What a model says of itself; `test_model_contract.py` holds that steps behave accordingly."""

import pytest
import torch

from herglotz.models import ContactLagrangian, ModelConfig, capabilities

EXPLICIT, BY_TERMS, JETS = "explicit", "by terms", "jets"
MODELS = [
    (ModelConfig(level="conservative"), EXPLICIT),
    (ModelConfig(level="linear", features=("cos(2 q1)",)), EXPLICIT),
    (ModelConfig(level="forced", inputs=1), EXPLICIT),
    (ModelConfig(level="linear", correction_width=4), BY_TERMS),
    (ModelConfig(level="forced", coulomb=True), BY_TERMS),
    (ModelConfig(level="affine"), BY_TERMS),
    (ModelConfig(level="full"), JETS),
    (ModelConfig(level="linear", mass_width=4), JETS),
    (ModelConfig(level="linear", features=("v1^2 cos(q1)",)), JETS),
    (ModelConfig(level="linear", correction_width=4, baseline=False), JETS),
    (ModelConfig(level="linear", potential_width=0, order=4), JETS),
]


@pytest.mark.parametrize(("config", "step"), MODELS, ids=lambda x: x if isinstance(x, str) else x.level)
def test_how_a_step_is_made_follows_from_the_terms(config, step):
    # fails if a term is added to a model and its step is still taken for one without that term
    found = ContactLagrangian(config).capabilities
    assert (EXPLICIT if found.explicit else BY_TERMS if found.by_terms else JETS) == step
    assert found.carries_s == (config.level in ("affine", "full"))
    assert found.linear_in_q1 == (step == EXPLICIT)


def test_nothing_is_known_of_what_is_no_model():
    # fails if a discrete Lagrangian that is not a sum of these terms is stepped as if it were one
    assert capabilities(lambda q0, q1, s0, h: (q1 - q0).square().sum(-1) / h - s0) is None


def test_the_typical_increment_is_that_of_the_fastest_coordinate():
    # fails if it is that of the slowest: a step then iterates for digits that the fast coordinate does not have
    one = (1.0, 1.0)
    config = ModelConfig((False, False), "linear", one, (0.5, 3.0), one, (0.0, 0.0), potential_width=0)
    model = ContactLagrangian(config)
    assert float(model.typical_increment(torch.tensor(0.1, dtype=torch.float64))) == pytest.approx(0.3)
