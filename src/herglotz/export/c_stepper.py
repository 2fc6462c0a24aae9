"""A generated header, compiled and loaded: the interface of `herglotz.stepping.Stepper` at the speed of C."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from herglotz.codegen.c_compiler import build
from herglotz.data.files import PathLike
from herglotz.export.c_header import MAX_DERIVATIVES, read_metadata, runtime
from herglotz.export.exported import ExportedStepper
from herglotz.stepping import Status
from herglotz.stepping.rollout import Track


def library_of(name: str) -> str:
    """The loops around a header whose prefix is `name`."""
    return re.sub(r"\bhz_", f"{name}_", runtime("library.c"))


class CLibrary:
    """The compiled functions of a generated header, sample by sample on one thread, as functions of tensors.

    `path` is named in messages; `whole` gives the header with derivatives, where this one has none. Raise InputError if
    the text is not such a header, or no C compiler is there to compile it.
    """

    def __init__(self, header: str, path: PathLike, whole: Callable[[], str] | None = None):
        self.metadata = read_metadata(header, path)
        self.dof: int = self.metadata["dof"]
        self.inputs: int = self.metadata["inputs"]
        self.dtype: torch.dtype = getattr(torch, self.metadata["dtype"])
        self.library = build(header, library_of(self.metadata["name"]))
        self.whole = whole
        self.differentiates = self.library if whole is None else None

    def init(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, u: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(p1, s1) at q1; NaN where there is none."""
        p, s, status = self._empty(len(s0), self.dof), self._empty(len(s0)), self._failed(len(s0))
        self.library.herglotz_inits(*_arguments(len(s0), q0, q1, s0, h, u, p, s, status))
        return p, s

    def momentum(self, q: Tensor, v: Tensor, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """The momenta p of velocities, NaN where there is none, and statuses."""
        p, status = self._empty(len(s), self.dof), self._failed(len(s))
        self._differentiating().herglotz_momenta(*_arguments(len(s), q, v, s, h, p, status))
        return p, status

    def velocity(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """The velocities v of momenta, NaN where there is none, and statuses."""
        v, status = self._empty(len(s), self.dof), self._failed(len(s))
        self._differentiating().herglotz_velocities(*_arguments(len(s), q, p, s, h, v, status))
        return v, status

    def _differentiating(self) -> Any:
        """The library with derivatives and velocities, built on first use: most steppers are asked for neither."""
        if self.differentiates is None:
            assert self.whole is not None
            self.differentiates = build(self.whole(), library_of(self.metadata["name"]))
        return self.differentiates

    def linearise(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None) -> tuple[Tensor, ...]:
        """A step and its derivative (B, 2n+1, 2n+2+m); NaN where the step failed."""
        count, size = len(s), 2 * self.dof + 1
        widths = ((self.dof,), (self.dof,), (), ())
        *new, sigma = (self._empty(count, *width) for width in widths)
        status, residual = self._failed(count), self._empty(count)
        slopes = [self._empty(count, size, width) for width in (size, self.inputs, 1)]
        outputs = (*new, sigma, status, residual, *slopes)
        self._differentiating().herglotz_jacobians(*_arguments(count, q, p, s, h, u, *outputs))
        by_state, by_input, by_h = slopes
        return *new, sigma, residual, status, torch.cat([by_state, by_h, by_input], -1)

    def __call__(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None) -> Track:
        """K steps: h (B, K) and u (B, K, m) may be expanded over samples, and h over steps."""
        run, outputs = self.prepared(q, p, s, h, u)
        run()
        *states, sigma, status, residual = outputs
        return Track(tuple(states), sigma, status, residual)

    def prepared(
        self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None
    ) -> tuple[Callable[[], None], tuple[Tensor, ...]]:
        """The same call with its arguments made beforehand, and the tensors that it writes."""
        (count, steps), n = h.shape, self.dof
        u = u if u is None or u[0].is_contiguous() else u.contiguous()
        outputs = (
            self._empty(count, steps + 1, n), self._empty(count, steps + 1, n), self._empty(count, steps + 1),
            self._empty(count, steps + 1), self._failed(count, steps), self._empty(count, steps),
        )  # fmt: skip
        u_stride = 0 if u is None else u.stride(0)
        keep = (*(x.contiguous() for x in (q, p, s)), h, *h.stride(), u, u_stride, *outputs)
        arguments = _arguments(count, steps, *keep)
        function = self.library.herglotz_rollouts
        return lambda keep=keep: function(*arguments), outputs  # noqa: ARG005  the tensors live as long as the call

    def _empty(self, *shape: int) -> Tensor:
        return torch.full(shape, torch.nan, dtype=self.dtype)

    def _failed(self, *shape: int) -> Tensor:
        return torch.full(shape, int(Status.DIVERGED), dtype=torch.uint8)


def _arguments(*values: Tensor | int | None) -> list[Any]:
    """Numbers and addresses as C takes them."""
    return [
        ctypes.c_long(x) if isinstance(x, int) else ctypes.c_void_p(None if x is None else x.data_ptr()) for x in values
    ]


def compiled(header: str, path: PathLike = "header", whole: Callable[[], str] | None = None) -> ExportedStepper:
    """The stepper of a header; arguments and errors as of `CLibrary`."""
    library = CLibrary(header, path, whole)
    programs: dict[str, Any] = {"init": library.init}
    if library.dof <= MAX_DERIVATIVES:
        programs["linearise"] = library.linearise
    if whole is not None or "_VELOCITIES" in header:
        programs |= {"momentum": library.momentum, "velocity": library.velocity}
    return ExportedStepper(programs, library.metadata, str(path), "c", library)
