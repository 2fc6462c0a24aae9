"""A trace follows what is written in place into a tensor, and refuses to read it through another view."""

import pytest
import torch

from herglotz.codegen.trace import traced
from herglotz.errors import InputError

BATCH = torch.rand(1021, 2, dtype=torch.float64)


def test_a_written_tensor_is_what_was_written():
    # fails if a write in place is lost: the sum would be that of the tensor before; or if a view that is made after the
    # write is refused
    def function(x):
        y = x * 2.0
        y.add_(1.0)
        y.mul_(x)
        return y + 0.5, y.reshape(-1, 2, 1) * 2.0

    graph = traced(function, (BATCH,))
    other = torch.rand(7, 2, dtype=torch.float64)
    torch.testing.assert_close(graph(other), function(other), rtol=0, atol=0)


@pytest.mark.parametrize("write", [
    lambda y, _: y.diagonal(dim1=1, dim2=2).fill_(1.0),
    lambda y, _: y[:, 0].zero_(),
    lambda y, _: y.select(1, 0).copy_(y[:, 1] * 0.0 + 3.0),
    lambda y, x: y[:, 0].copy_(x),
], ids=["diagonal", "row", "copied", "input"])  # fmt: skip
@pytest.mark.parametrize("constant", [False, True])
def test_what_is_written_through_a_view_is_not_read_from_its_base(write, constant):
    # fails if the trace is silently what it was before the write, 0 where there is a 1, or if the numbers of the
    # example's input become constants of the trace
    def function(x):
        y = torch.zeros(len(x), 2, 2, dtype=torch.float64) if constant else x[:, :, None] * torch.zeros(2).double()
        write(y, x)
        return (y + x[:, :, None],)

    with pytest.raises(InputError, match="writes in place through a view"):
        traced(function, (BATCH,))
