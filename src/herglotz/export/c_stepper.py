"""A generated header, compiled and loaded: the interface of `herglotz.stepping.Stepper` at the speed of C."""

from __future__ import annotations

import copy
import ctypes
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from herglotz.data.files import PathLike, read_bytes
from herglotz.data.seal import check_seal, sealed_text
from herglotz.errors import InputError
from herglotz.export.c_header import MAX_DERIVATIVES, MAX_ITERATIONS, c_source, described, read_metadata
from herglotz.export.c_wrapper import build
from herglotz.export.inputs import check_every, check_inputs, check_range, check_state, checked_h, decimated, spread_h
from herglotz.export.metadata import weights_digest
from herglotz.export.trusted import check_trusted
from herglotz.models import ContactLagrangian
from herglotz.stepping import Linearised, Rollout, State, Status, Step, step_sizes
from herglotz.stepping.state import check_started


class CompiledStepper:
    """The flow Φ̃ of a generated header, sample by sample on one thread.

    Results are those of `Stepper`; `linearise` gives their derivatives, autograd does not see them.

    Parameters
    ----------
    header
        What `export_c` wrote.
    path
        Where it came from, for messages.
    whole
        Gives the header with derivatives, where this one has none.

    Raises
    ------
    InputError
        If the text is not such a header, or no C compiler is there to compile it.
    """

    def __init__(self, header: str, path: PathLike = "header", whole: Callable[[], str] | None = None):
        self.metadata = read_metadata(header, path)
        self.path = str(path)
        self.dof: int = self.metadata["dof"]
        self.dtype: torch.dtype = getattr(torch, self.metadata["dtype"])
        self.h: float = self.metadata["h"]
        self.inputs: int = self.metadata["inputs"]
        self._library = build(header, self.metadata["name"])
        self._whole = whole
        self._differentiates = self._library if whole is None else None

    def init(
        self,
        q0: Tensor,
        q1: Tensor,
        s0: Tensor | None = None,
        h: Tensor | float = 1.0,
        u: Tensor | None = None,
    ) -> State:
        """The state (q1, p1, s1) = FL⁺(q0, q1, s0) from two positions; s0 defaults to 0. Errors as `Stepper.init`."""
        s0 = torch.zeros_like(q0[..., 0]) if s0 is None else s0
        self._check(q0, q1, s0)
        h = spread_h(self._checked_h(h), s0).contiguous()
        u = self._inputs(u, s0.shape)
        p = torch.full(q0.shape, torch.nan, dtype=self.dtype)
        s = torch.full(s0.shape, torch.nan, dtype=self.dtype)
        status = torch.zeros(s0.shape, dtype=torch.uint8)
        starts = [x.contiguous() for x in (q0, q1, s0)]
        self._call("herglotz_inits", s0.numel(), *starts, h, 1, u, self.inputs, p, s, status)
        return check_started(State(q1, p, s))

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None, u: Tensor | None = None) -> Step:
        """One step.

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...), in the dtype of the header.
        h
            Time step > 0, scalar or (...).
        guess
            Taken for the sake of `Stepper`'s signature; the header has its own guess.
        u
            (m,) or (..., m) input of this step, for a model with inputs; None: no input acts.

        Returns
        -------
        Step
            NaN in the samples whose status is not `Status.CONVERGED`. `iterations` is the bound, not a count.

        Raises
        ------
        InputError
            If a shape, the dtype or a value is not what the header takes.
        """
        del guess
        q, p, s = state
        self._check(q, p, s)
        h = spread_h(self._checked_h(h), s)[..., None]
        out = self._rollout(q, p, s, h, None if u is None else u.expand(*s.shape, u.shape[-1])[..., None, :])
        outside = None if out.outside is None else out.outside[..., 0]
        return Step(out.final, out.sigma[..., 1], out.status[..., 0], out.residual[..., 0], MAX_ITERATIONS, outside)

    def linearise(self, state: State, h: Tensor | float, u: Tensor | None = None) -> Linearised:
        """One step with its derivatives, as `Stepper.linearise`; NaN where the step failed.

        Parameters
        ----------
        state, h, u
            As in `step`.

        Raises
        ------
        InputError
            As `step`, and beyond 8 coordinates.
        """
        if self.dof > MAX_DERIVATIVES:
            raise InputError(f"C has no derivatives beyond {MAX_DERIVATIVES} coordinates; use Stepper.linearise")
        q, p, s = state
        self._check(q, p, s)
        batch, size = s.shape, 2 * self.dof + 1
        h = spread_h(self._checked_h(h), s).contiguous()
        u = self._inputs(None if u is None else u.expand(*batch, u.shape[-1]), batch)
        new = lambda *shape: torch.full((*batch, *shape), torch.nan, dtype=self.dtype)  # noqa: E731
        after, sigma, residual = State(new(self.dof), new(self.dof), new()), new(), new()
        status = torch.full(batch, int(Status.DIVERGED), dtype=torch.uint8)
        by_state, by_input, by_h = new(size, size), new(size, self.inputs), new(size)
        starts = (x.contiguous() for x in state)
        outputs = (*after, sigma, status, residual, by_state, by_input, by_h)
        if self._differentiates is None:  # built on first use: most steppers are not differentiated
            assert self._whole is not None
            self._differentiates = build(self._whole(), self.metadata["name"])
        self._call("herglotz_jacobians", s.numel(), *starts, h, u, *outputs, library=self._differentiates)
        step = Step(after, sigma, status, residual, MAX_ITERATIONS)
        return Linearised(step, by_state, by_h, by_input if u is not None else None)

    def rollout(
        self,
        q: Tensor,
        p: Tensor,
        s: Tensor | None = None,
        *,
        h: Tensor | float,
        steps: int | None = None,
        inputs: Tensor | None = None,
        every: int = 1,
        events: Sequence[Any] = (),
        checkpoint: int | None = None,
        chunk: int = 1024,
    ) -> Rollout:
        """Step K times from (q, p, s); everything after a failed step is NaN.

        Parameters
        ----------
        q, p, s
            (..., n), (..., n), (...); s defaults to 0.
        h
            A scalar for equal steps, (K,) for steps shared by the batch, or (..., K).
        steps
            K; needed for a scalar h without inputs only.
        inputs
            (K, m) or (..., K, m): u_k of each step, for a model with inputs; None: no input acts.
        every
            Keep each m-th state only; m divides K. Statuses and residuals are the worst of the m steps.
        events
            Refused: they need `Stepper`.
        checkpoint, chunk
            Taken for the sake of `Stepper`'s signature; nothing is differentiated or gathered here.

        Raises
        ------
        InputError
            As `step`, and if lengths disagree.
        """
        del checkpoint, chunk
        if events:
            raise InputError("a compiled stepper has no events; use herglotz.Stepper")
        s = torch.zeros_like(q[..., 0]) if s is None else s
        self._check(q, p, s)
        if inputs is not None and inputs.ndim > 1 and steps is None and torch.as_tensor(h).ndim == 0:
            steps = inputs.shape[-2]
        h = step_sizes(self._checked_h(h), steps)
        check_every(every, h.shape[-1])
        return decimated(self._rollout(q, p, s, h, inputs), every)

    def outside_box(self, state: State) -> Tensor:
        """(...) True where a state lies outside the box the model was fitted in; angles count modulo 2π.

        Raises
        ------
        InputError
            If the header records no box.
        """
        if self.metadata["box"] is None:
            raise InputError(f"{self.path}: records no box; export it again with box=")
        self._check(*state, finite=False)
        out = torch.zeros(state.s.shape, dtype=torch.uint8)
        self._call("herglotz_outside_box", state.s.numel(), *(x.contiguous() for x in state), out)
        return out.bool()

    def _rollout(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None) -> Rollout:
        """Steps of h (K,) or (..., K), with inputs (K, m) or (..., K, m)."""
        batch, steps = s.shape, h.shape[-1]
        shared = h.ndim == 1
        h = h.contiguous() if shared else spread_h(h, s[..., None].expand(*batch, steps)).contiguous()
        common = u is not None and u.ndim == 2
        u = self._inputs(u, (steps,) if common else (*batch, steps))
        q_out, p_out = (torch.full((*batch, steps + 1, self.dof), torch.nan, dtype=self.dtype) for _ in "qp")
        s_out, sigma = (torch.full((*batch, steps + 1), torch.nan, dtype=self.dtype) for _ in range(2))
        residual = torch.full((*batch, steps), torch.nan, dtype=self.dtype)
        status = torch.full((*batch, steps), int(Status.DIVERGED), dtype=torch.uint8)
        starts = [x.contiguous() for x in (q, p, s)]
        h_stride, u_stride = 0 if shared else steps, 0 if common else steps * self.inputs
        outputs = (q_out, p_out, s_out, sigma, status, residual)
        self._call("herglotz_rollouts", s.numel(), steps, *starts, h, h_stride, 1, u, u_stride, *outputs)
        outside = None
        if self.metadata["box"] is not None:
            there = self.outside_box(State(q_out, p_out, s_out))
            outside = (there[..., 1:] | there[..., :-1]).to(torch.uint8)
        return Rollout(q_out, p_out, s_out, sigma, status, residual, outside=outside)

    def _inputs(self, u: Tensor | None, shape: tuple[int, ...]) -> Tensor | None:
        """Inputs (*shape, m), checked; None where there are none."""
        if u is None:
            return None
        check_inputs(u, self.inputs, shape, self.dtype)
        return u.contiguous()

    def _checked_h(self, h: Tensor | float) -> Tensor:
        h = checked_h(h, self.dtype)
        check_range(h, self.metadata["h_range"])
        return h

    def _call(self, function: str, *arguments: Tensor | int | None, library: ctypes.CDLL | None = None) -> None:
        converted = (
            ctypes.c_long(x) if isinstance(x, int) else ctypes.c_void_p(None if x is None else x.data_ptr())
            for x in arguments
        )
        getattr(library or self._library, function)(*converted)

    def _check(self, q: Tensor, p: Tensor, s: Tensor, finite: bool = True) -> None:
        check_state(q, p, s, self.dof, self.dtype, finite=finite)
        for name, x in (("q", q), ("p", p), ("s", s)):
            if x.device.type != "cpu" or x.requires_grad:
                raise InputError(
                    f"{name} must be on the CPU and without gradient; use Stepper, or {name}.detach().cpu()"
                )


def read_header(path: PathLike) -> tuple[str, dict[str, Any]]:
    """The text of a header and its metadata; nothing of it is compiled.

    Raises
    ------
    InputError
        If the file cannot be read, was changed or is no such header.
    """
    content = read_bytes(path)
    check_seal(content, path, text=True)
    text = content.decode("utf-8", "replace")
    return text, read_metadata(text, path)


def load_c(path: PathLike, *, trust_code: bool = False, model: ContactLagrangian | None = None) -> CompiledStepper:
    """Compile a header that `export_c` wrote, and load it.

    Parameters
    ----------
    path
        The header.
    trust_code
        Compile a header that was not written by this user on this machine: that runs what stands in it.
    model
        Of the run it was exported from: a header that is what this model gives, letter for letter, needs no trust.

    Returns
    -------
    CompiledStepper
        With the header's own dtype and its `metadata`.

    Raises
    ------
    InputError
        If the file cannot be read, was changed, is no such header or not trusted, or there is no compiler.
    """
    text, _ = read_header(path)
    content = text.encode()
    check_trusted(content, path, trust_code or (model is not None and _is_of(text, path, model)))
    return CompiledStepper(text, path)


def _is_of(text: str, path: PathLike, model: ContactLagrangian) -> bool:
    """Whether the header is what the model gives with the header's own metadata."""
    entries = read_metadata(text, path)
    if entries.get("weights_sha256") != weights_digest(model):
        return False
    file = re.search(r'#include "([^"\n]*)"', text)
    try:
        return text == sealed_text(c_source(model, entries, file[1] if file else ""))
    except (KeyError, ValueError, TypeError, AttributeError):  # metadata that this version would not have written
        return False


def compile_c(
    source: PathLike | ContactLagrangian,
    *,
    h: float = 1.0,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    dtype: str | None = None,
    tolerance: float | None = None,
    trust_code: bool = False,
) -> CompiledStepper:
    """Compile a header that `export_c` wrote, or a model directly, and load it.

    The library is kept in ~/.cache/herglotz/c (or $XDG_CACHE_HOME) by the hash of its source, the compiler and the
    processor. The compiler is $CC, or cc, gcc or clang from the PATH.

    Parameters
    ----------
    source
        A header, or a model.
    h, box, units, dtype, tolerance
        As in `export_c`, for a model only; dtype defaults to the model's.
    trust_code
        As in `load_c`, for a header only.

    Returns
    -------
    CompiledStepper
        A drop-in for `Stepper`.

    Raises
    ------
    InputError
        If there is no compiler, or the source is not usable.
    """
    if not isinstance(source, ContactLagrangian):
        return load_c(source, trust_code=trust_code)
    dtype = dtype or str(next(source.parameters()).dtype).removeprefix("torch.")
    entries = described(source, h, box, units, "model", dtype, None, tolerance, {})
    kept = copy.deepcopy(source)  # the model may be trained on
    header = c_source(kept, entries, "stepper.h", derivatives=False)
    return CompiledStepper(header, "compiled model", lambda: c_source(kept, entries, "stepper.h"))
