"""Sums of normal equations and gradients over the processes of `torchrun`; a single process is not affected.

Every process holds the data and runs the same optimiser. The work that grows with the data (Jacobians of chunks of
triples or steps, runs over segments) is divided among the processes and the sums are all-reduced. The last bits of a
process's own results depend on the alignment of its memory, so all values that decide the optimiser's path come from
the first process.
"""

from __future__ import annotations

import functools
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

# Rows are divided into at most MAX_PARTS parts of at least MIN_ROWS rows.
MAX_PARTS, MIN_ROWS = 8, 1024
# Part k is added to sum k mod 2, so that one process and two add the same numbers in the same order.
LANES = 2
# Seconds that a process waits for the others, which do equal shares of the work between two sums.
TIMEOUT = 60


def world() -> tuple[int, int]:
    """(rank, number of processes); (0, 1) without a process group."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_available() and dist.is_initialized() else (0, 1)


def is_first() -> bool:
    """True for the process that writes files and prints."""
    return world()[0] == 0


def own_parts(count: int, most: int, device: torch.device) -> Iterator[tuple[int, Tensor]]:
    """The parts of `count` rows that this process works on, at most `most` rows each: (lane, rows).

    Parts and lanes do not depend on the number of processes: batches of another size, and sums in another order, differ
    in their last bits, which changes poorly determined numbers far more.
    """
    parts = 1
    while parts < MAX_PARTS and count >= 2 * parts * MIN_ROWS:
        parts *= 2
    size = max(1, min(most, -(-count // parts)))
    rank, processes = world()
    for k, rows in enumerate(torch.arange(count, device=device).split(size)):
        if k % processes == rank:
            yield k % LANES, rows


class LaneSums:
    """Sums over parts in two lanes, part k in lane k mod 2: bit-equal for one process and for two."""

    def __init__(self, *zeros: Tensor):
        self.lanes = [tuple(torch.zeros_like(x) for x in zeros) for _ in range(LANES)]

    def add(self, lane: int, *terms: Tensor) -> None:
        """Add the terms of a part."""
        for x, term in zip(self.lanes[lane], terms, strict=True):
            x += term

    def total(self) -> tuple[Tensor, ...]:
        """The sums over all parts of all processes."""
        for lane in self.lanes:
            add_over_processes(*lane)
        return tuple(functools.reduce(torch.add, x) for x in zip(*self.lanes, strict=True))


def add_over_processes(*tensors: Tensor) -> None:
    """Sum each tensor over the processes, in place, with bit-equal results everywhere; one message holds them all."""
    if world()[1] == 1:
        return
    whole = torch.cat([x.flatten() for x in tensors])
    dist.all_reduce(whole)
    dist.broadcast(whole, 0)
    for x, part in zip(tensors, whole.split([x.numel() for x in tensors]), strict=True):
        x.copy_(part.view_as(x))


def processors() -> int:
    """Processors for the threads of this process: an equal share for each process of `torchrun` on this machine."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, count // (int(os.environ.get("LOCAL_WORLD_SIZE", world()[1])) if world()[1] > 1 else 1))


def of_first(*tensors: Tensor) -> tuple[Tensor, ...]:
    """The first process's values of these tensors, in every process."""
    if world()[1] == 1:
        return tensors
    shared = tuple(x.detach().clone() for x in tensors)
    for x in shared:
        dist.broadcast(x, 0)
    return shared


def everywhere(holds: bool) -> bool:
    """True if `holds` is true in every process."""
    if world()[1] == 1:
        return holds
    flag = torch.tensor(float(holds), device="cuda" if dist.get_backend() == "nccl" else "cpu")
    dist.all_reduce(flag, dist.ReduceOp.MIN)
    return bool(flag)


@contextmanager
def process_group() -> Iterator[None]:
    """Join the group of processes that `torchrun` started (NCCL with a GPU, gloo without), and leave it at the end.

    Raise RuntimeError if another process ends, or does not answer for 60 seconds.
    """
    if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
        yield
        return
    # torch.distributed.nn.functional keeps a reference to the group that exists at its first import. A fit imports it
    # (by torch._dynamo): gloo's threads would then outlive the group, and abort while Python exits.
    importlib.import_module("torch.distributed.nn.functional")
    limit = timedelta(seconds=float(os.environ.get("HERGLOTZ_TIMEOUT", TIMEOUT)))
    dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo", timeout=limit)
    try:
        yield
    except RuntimeError as error:
        words = str(error).lower()
        if "timed out" in words:
            what = f"has not answered for {limit.total_seconds():g} s: it was stopped, or is slower than that "
            what += "(HERGLOTZ_TIMEOUT sets the seconds)"
        # gloo reports a closed connection with these words.
        elif "by peer" in words:
            what = "has ended: it was killed, or an error of its own ended it"
        else:
            raise
        raise RuntimeError(f"a process of torchrun {what}; start again with resume") from error
    finally:
        dist.destroy_process_group()
