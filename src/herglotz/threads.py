"""Computation on one thread, which is fastest for small matrices."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread inside, and restore the caller's number of threads; also a decorator.

    The matrices are small: on a busy machine of two cores a fit on both took ten times as long as on one. A number
    that the user sets in `OMP_NUM_THREADS` is kept.
    """
    before = torch.get_num_threads()
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
