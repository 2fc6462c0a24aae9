"""A trace follows what is written in place into a tensor, and refuses to read it through another view."""

import pytest
import torch

from herglotz.codegen.trace import traced
from herglotz.errors import InputError

BATCH = torch.rand(1021, 2, dtype=torch.float64)


def test_a_written_tensor_is_what_was_written():
    # fails if a write in place is lost: the sum would be that of the tensor before
    def function(x):
        y = x * 2.0
        y.add_(1.0)
        y.mul_(x)
        return (y + 0.5,)

    graph = traced(function, (BATCH,))
    other = torch.rand(7, 2, dtype=torch.float64)
    torch.testing.assert_close(graph(other)[0], function(other)[0], rtol=0, atol=0)


@pytest.mark.parametrize("write", [
    lambda y: y.diagonal(dim1=1, dim2=2).fill_(1.0),
    lambda y: y[:, 0].zero_(),
    lambda y: y.select(1, 0).copy_(y[:, 1] * 0.0 + 3.0),
], ids=["diagonal", "row", "copied"])  # fmt: skip
def test_what_is_written_through_a_view_is_not_read_from_its_base(write):
    # fails if the trace is silently what it was before the write: 0 where there is a 1
    def function(x):
        y = x[:, :, None] * torch.zeros(2, dtype=torch.float64)
        write(y)
        return (y + x[:, :, None],)

    with pytest.raises(InputError, match="writes in place through a view"):
        traced(function, (BATCH,))


def test_views_of_what_was_written_are_read():
    # fails if a view that is made after the write is refused
    def function(x):
        y = x.clone()
        y.add_(1.0)
        return (y.reshape(-1, 2, 1) * 2.0,)

    graph = traced(function, (BATCH,))
    other = torch.rand(5, 2, dtype=torch.float64)
    torch.testing.assert_close(graph(other)[0], function(other)[0], rtol=0, atol=0)


def test_numbers_of_inputs_written_into_constants_are_not_lost():
    # fails if the example's numbers become constants of the trace
    def function(x):
        y = torch.zeros(1021, 2, 2, dtype=torch.float64)
        y[:, 0] = x
        return (y + 0.0 * x[:, :, None],)

    with pytest.raises(InputError, match="writes in place through a view"):
        traced(function, (BATCH,))
