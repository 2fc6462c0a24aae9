"""A generated header, compiled and loaded, with the interface of `herglotz.stepping.Stepper`."""

from __future__ import annotations

import copy
import ctypes
import re
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import torch
from torch import Tensor

from herglotz.codegen.c_compiler import build
from herglotz.data.files import PathLike
from herglotz.export.c_header import MAX_DERIVATIVES, read_metadata, runtime
from herglotz.export.exported import ExportedStepper
from herglotz.export.lower.c_parameters import without_parameters
from herglotz.export.parameters import checked_values
from herglotz.stepping import Status
from herglotz.stepping.rollout import Track


def library_of(metadata: Mapping[str, Any]) -> str:
    """The C source of the loops over samples around a header with this metadata."""
    text = runtime("library.c")
    text = text if metadata.get("parameters") else without_parameters(text)
    return re.sub(r"\bhz_", f"{metadata['name']}_", text)


class CLibrary:
    """The compiled functions of a generated header as functions of tensors, on one thread.

    `path` is named in messages; `whole` gives the header with derivatives, where this one has none. Raise InputError if
    the text is not such a header, or no C compiler is there to compile it.
    """

    def __init__(self, header: str, path: PathLike, whole: Callable[[], str] | None = None):
        self.metadata = read_metadata(header, path)
        self.dof: int = self.metadata["dof"]
        self.inputs: int = self.metadata["inputs"]
        self.dtype: torch.dtype = getattr(torch, self.metadata["dtype"])
        self.parameters: dict[str, Any] = self.metadata.get("parameters", {})
        self.theta = torch.tensor(checked_values(self.parameters, {}), dtype=self.dtype)
        self.library = build(header, library_of(self.metadata))
        # Built on first use, once for all copies: most steppers are not differentiated.
        self.differentiates = cache(
            lambda: self.library if whole is None else build(whole(), library_of(self.metadata))
        )

    def with_values(self, values: Mapping[str, float]) -> CLibrary:
        """The library with these values of numbers that are set at run time; numbers not named have their defaults."""
        other = copy.copy(self)
        other.theta = torch.tensor(checked_values(self.parameters, values), dtype=self.dtype)
        return other

    @property
    def _theta(self) -> tuple[Tensor, ...]:
        return (self.theta,) if self.parameters else ()

    def init(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, u: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(p1, s1) at q1; NaN where the step from q0 to q1 has none."""
        p, s, status = self._empty(len(s0), self.dof), self._empty(len(s0)), self._failed(len(s0))
        self.library.herglotz_inits(*_arguments(len(s0), q0, q1, s0, h, u, *self._theta, p, s, status))
        return p, s

    def momentum(self, q: Tensor, v: Tensor, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """The momenta p of velocities, NaN where a velocity has no momentum, and statuses."""
        p, status = self._empty(len(s), self.dof), self._failed(len(s))
        self.differentiates().herglotz_momenta(*_arguments(len(s), q, v, s, h, *self._theta, p, status))
        return p, status

    def velocity(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """The velocities v of momenta, NaN where a momentum has no velocity, and statuses."""
        v, status = self._empty(len(s), self.dof), self._failed(len(s))
        self.differentiates().herglotz_velocities(*_arguments(len(s), q, p, s, h, *self._theta, v, status))
        return v, status

    def linearise(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None) -> tuple[Tensor, ...]:
        """A step and its derivative (B, 2n+1, 2n+2+m+K); NaN where the step failed."""
        count, size = len(s), 2 * self.dof + 1
        widths = ((self.dof,), (self.dof,), (), ())
        *new, sigma = (self._empty(count, *width) for width in widths)
        status, residual = self._failed(count), self._empty(count)
        by_state, by_input, by_theta, by_h = slopes = [
            self._empty(count, size, width) for width in (size, self.inputs, len(self.parameters), 1)
        ]
        written = slopes if self.parameters else (by_state, by_input, by_h)
        outputs = (*new, sigma, status, residual, *written)
        self.differentiates().herglotz_jacobians(*_arguments(count, q, p, s, h, u, *self._theta, *outputs))
        return *new, sigma, residual, status, torch.cat([by_state, by_h, by_input, by_theta], -1)

    def __call__(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None) -> Track:
        """K steps: h (B, K) and u (B, K, m) may be expanded over samples, and h over steps."""
        run, outputs = self.prepared(q, p, s, h, u)
        run()
        *states, sigma, status, residual = outputs
        return Track(tuple(states), sigma, status, residual)

    def prepared(
        self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None
    ) -> tuple[Callable[[], None], tuple[Tensor, ...]]:
        """A call of the rollout with its arguments already converted, and the tensors that the call writes."""
        (count, steps), n = h.shape, self.dof
        u = u if u is None or u[0].is_contiguous() else u.contiguous()
        outputs = (
            self._empty(count, steps + 1, n), self._empty(count, steps + 1, n), self._empty(count, steps + 1),
            self._empty(count, steps + 1), self._failed(count, steps), self._empty(count, steps),
        )  # fmt: skip
        u_stride = 0 if u is None else u.stride(0)
        keep = (*(x.contiguous() for x in (q, p, s)), h, *h.stride(), u, u_stride, *self._theta, *outputs)
        arguments = _arguments(count, steps, *keep)
        function = self.library.herglotz_rollouts
        # `keep` keeps the tensors alive as long as the call.
        return lambda keep=keep: function(*arguments), outputs  # noqa: ARG005

    def holds(
        self, states: Tensor, h: Tensor, u: Tensor, steps: int, low: Tensor, high: Tensor, out: tuple[Tensor, Tensor]
    ) -> Callable[[], None]:
        """The call that steps `states` in place, each under its input, and observes the states (`herglotz_holds`).

        States are rows (q, p, s, σ), (B, 2n+2); u is (B, m). The call writes `out`: (q, v), (B, 2n), with q between low
        and high (n,), and statuses (B,) int32 with their flags.
        """
        keep = (states, h, u, *self._theta, low, high, *out)
        arguments, function = _arguments(len(states), steps, *keep), self.differentiates().herglotz_holds
        return lambda keep=keep: function(*arguments)  # noqa: ARG005

    def _empty(self, *shape: int) -> Tensor:
        return torch.full(shape, torch.nan, dtype=self.dtype)

    def _failed(self, *shape: int) -> Tensor:
        return torch.full(shape, int(Status.DIVERGED), dtype=torch.uint8)


def _arguments(*values: Tensor | int | None) -> list[Any]:
    """Numbers and addresses of tensors as arguments of a C function."""
    return [
        ctypes.c_long(x) if isinstance(x, int) else ctypes.c_void_p(None if x is None else x.data_ptr()) for x in values
    ]


def compiled(header: str, path: PathLike = "header", whole: Callable[[], str] | None = None) -> ExportedStepper:
    """The stepper of a header; arguments and errors are those of `CLibrary`."""
    return stepper_of(CLibrary(header, path, whole), str(path), whole is not None or "_VELOCITIES" in header)


def stepper_of(library: CLibrary, path: str, velocities: bool) -> ExportedStepper:
    """The stepper of a compiled header."""
    programs: dict[str, Any] = {"init": library.init}
    if library.dof <= MAX_DERIVATIVES:
        programs["linearise"] = library.linearise
    if velocities:
        programs |= {"momentum": library.momentum, "velocity": library.velocity}
    again = lambda values: stepper_of(library.with_values(values), path, velocities)  # noqa: E731
    return ExportedStepper(programs, library.metadata, path, "c", library, again)
