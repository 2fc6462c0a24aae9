"""A slice of `make fuzz`: 25 damaged files of every kind that needs no export; test_bit_flips.py has exported ones."""

from tests.fuzz import fuzz


def test_no_damaged_file_loads_or_raises_something_else(tmp_path):
    # fails if a reader lets another exception than `InputError` through, or takes a damaged file for a whole one
    counts = fuzz(tmp_path, least=25, seed=1, exports=False)
    assert len(counts) == 9
    assert {name: count for name, count in counts.items() if not count.good} == {}
