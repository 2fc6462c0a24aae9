"""One thread for small matrices, in Python as on the command line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread inside, and give the caller's number of threads back; usable as a decorator.

    The matrices here are small: on a busy machine of two cores, a fit on all cores was measured to take ten times as
    long as on one. A user who sets `OMP_NUM_THREADS` has chosen, and keeps that number.
    """
    before = torch.get_num_threads()
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
