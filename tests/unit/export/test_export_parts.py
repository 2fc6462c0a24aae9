"""Small parts of what is exported: the compensated sum and the range of steps."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.export.inputs import check_range
from herglotz.export.step import _added


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_rounding_takes_from_a_sum_is_kept(dtype):
    # fails if what was lost is not added to the next change: 1000 changes below the rounding of 1 then leave it at 1
    eps = torch.finfo(dtype).eps
    x, lost, change = torch.ones(3, dtype=dtype), (torch.zeros(3, dtype=dtype),), torch.full((3,), eps / 5, dtype=dtype)
    for _ in range(1000):
        x, *lost = _added(x, change, tuple(lost))
    assert (x - 1 + lost[0]).tolist() == pytest.approx([200 * eps] * 3, rel=1e-5, abs=0)
    assert _added(x, change, ())[0].equal(x)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_at_the_ends_of_the_range_are_taken(dtype):
    # fails if the rounding of an end, in float32 say, is refused, or what is beyond it is not
    for span in ((0.1, 0.2), (0.3, 0.7)):
        check_range(torch.tensor(span, dtype=dtype), span)
        for wrong in (span[0] * (1 - 1e-5), span[1] * (1 + 1e-5)):
            with pytest.raises(InputError, match="where the model was fitted; got"):
                check_range(torch.tensor([span[0], wrong, span[1]], dtype=dtype), span)
    check_range(torch.tensor(9.0), None)
