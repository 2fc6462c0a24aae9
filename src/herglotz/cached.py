"""`cached`: tensors that depend on sizes alone, such as indices and masks, made once."""

from collections.abc import Callable
from functools import cache
from typing import TypeVar

import torch

T = TypeVar("T", bound=Callable)


def cached(function: T) -> T:
    """`functools.cache` for a function that makes tensors.

    The tensors are never those of inference mode, which autograd would refuse in later calls.
    """
    return cache(torch.inference_mode(mode=False)(function))  # pyright: ignore[reportReturnType]
