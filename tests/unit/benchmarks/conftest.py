"""What tests of several benchmarks need."""

import pytest
import torch


@pytest.fixture(scope="module")
def optimisers_are_imported():
    """The first step of an optimiser imports modules for a second, which would count in the budget of a peer."""
    x = torch.zeros(1, requires_grad=True)
    x.sum().backward()
    torch.optim.Adam([x]).step()
