"""Normal equations and gradients shared by the processes of `torchrun`; nothing at all in a single process.

Every process holds the data and runs the same optimiser. The work that grows with the data (Jacobians of chunks of
triples or steps) is dealt out and the sums are all-reduced. The last bits of what a process computes by itself depend
on where its memory lies; what decides the optimiser's path is therefore taken from the first process.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")


def world() -> tuple[int, int]:
    """(rank, number of processes); (0, 1) without a process group."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_available() and dist.is_initialized() else (0, 1)


def is_first() -> bool:
    """Whether this process writes files and prints."""
    return world()[0] == 0


def own_share(parts: Sequence[T]) -> list[T]:
    """The parts that this process works on: every world-size-th of them."""
    rank, size = world()
    return list(parts[rank::size])


def add_over_processes(*tensors: Tensor) -> None:
    """Sum each tensor over the processes, in place, with bit-equal results everywhere."""
    if world()[1] == 1:
        return
    for x in tensors:
        dist.all_reduce(x)
        dist.broadcast(x, 0)


def of_first(*tensors: Tensor) -> tuple[Tensor, ...]:
    """The first process's values of these tensors, everywhere."""
    if world()[1] == 1:
        return tensors
    shared = tuple(x.detach().clone() for x in tensors)
    for x in shared:
        dist.broadcast(x, 0)
    return shared


def everywhere(holds: bool) -> bool:
    """Whether something holds in every process."""
    if world()[1] == 1:
        return holds
    flag = torch.tensor(float(holds), device="cuda" if dist.get_backend() == "nccl" else "cpu")
    dist.all_reduce(flag, dist.ReduceOp.MIN)
    return bool(flag)


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that `torchrun` started (NCCL with a GPU, gloo without), and part from them at the end."""
    if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
        yield
        return
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()
