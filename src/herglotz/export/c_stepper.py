"""A generated header, compiled and loaded: the interface of `herglotz.stepping.Stepper` at the speed of C."""

from __future__ import annotations

import ctypes
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from herglotz.data.files import PathLike, read_bytes
from herglotz.errors import InputError
from herglotz.export.c_header import MAX_ITERATIONS, export_c, read_metadata
from herglotz.export.c_wrapper import build
from herglotz.export.inputs import check_state, checked_h
from herglotz.models import ContactLagrangian
from herglotz.stepping import Rollout, State, Status, Step, step_sizes


class CompiledStepper:
    """The flow Φ̃ of a generated header, sample by sample on one thread.

    Results are those of `Stepper`, without derivatives.

    Parameters
    ----------
    header
        What `export_c` wrote.
    path
        Where it came from, for messages.

    Raises
    ------
    InputError
        If the text is not such a header, or no C compiler is there to compile it.
    """

    def __init__(self, header: str, path: PathLike = "header"):
        self.metadata = read_metadata(header, path)
        self.path = str(path)
        self.dof: int = self.metadata["dof"]
        self.dtype: torch.dtype = getattr(torch, self.metadata["dtype"])
        self.h: float = self.metadata["h"]
        self._library = build(header, self.metadata["name"], self.metadata["dtype"])

    def init(self, q0: Tensor, q1: Tensor, s0: Tensor | None = None, h: Tensor | float = 1.0) -> State:
        """The state (q1, p1, s1) = FL⁺(q0, q1, s0) from two positions; s0 defaults to 0. NaN where it is not finite."""
        s0 = torch.zeros_like(q0[..., 0]) if s0 is None else s0
        self._check(q0, q1, s0)
        h = checked_h(h, self.dtype).expand(s0.shape).contiguous()
        p, s = (
            torch.full_like(q0, torch.nan, memory_format=torch.contiguous_format),
            torch.full(s0.shape, torch.nan, dtype=self.dtype),
        )
        status = torch.zeros(s0.shape, dtype=torch.uint8)
        inputs = [x.contiguous() for x in (q0, q1, s0)]
        self._call("herglotz_inits", s0.numel(), *inputs, h, 1, p, s, status)
        return State(q1, p, s)

    def step(self, state: State, h: Tensor | float) -> Step:
        """One step.

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...), in the dtype of the header.
        h
            Time step > 0, scalar or (...).

        Returns
        -------
        Step
            NaN in the samples whose status is not `Status.CONVERGED`. `iterations` is the bound, not a count.

        Raises
        ------
        InputError
            If a shape, the dtype or a value is not what the header takes.
        """
        q, p, s = state
        self._check(q, p, s)
        h = checked_h(h, self.dtype)
        out = self._rollout(q, p, s, _expand(h, s)[..., None])
        return Step(out.final, out.sigma[..., 1], out.status[..., 0], out.residual[..., 0], MAX_ITERATIONS)

    def rollout(
        self, q: Tensor, p: Tensor, s: Tensor | None = None, *, h: Tensor | float, steps: int | None = None
    ) -> Rollout:
        """Step K times from (q, p, s); everything after a failed step is NaN.

        Parameters
        ----------
        q, p, s
            (..., n), (..., n), (...); s defaults to 0.
        h
            A scalar for equal steps, (K,) for steps shared by the batch, or (..., K).
        steps
            K; needed for a scalar h only.

        Raises
        ------
        InputError
            As `step`, and if the length of h and `steps` disagree.
        """
        s = torch.zeros_like(q[..., 0]) if s is None else s
        self._check(q, p, s)
        h = step_sizes(checked_h(h, self.dtype), steps)
        return self._rollout(q, p, s, h)

    def outside_box(self, state: State) -> Tensor:
        """(...) True where a state lies outside the box the model was fitted in; angles count modulo 2π.

        Raises
        ------
        InputError
            If the header records no box.
        """
        if self.metadata["box"] is None:
            raise InputError(f"{self.path}: records no box; export it again with box=")
        out = torch.zeros(state.s.shape, dtype=torch.uint8)
        self._call("herglotz_outside_box", state.s.numel(), *(x.contiguous() for x in state), out)
        return out.bool()

    def _rollout(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor) -> Rollout:
        """Steps of h (K,) or (..., K)."""
        batch, steps = s.shape, h.shape[-1]
        shared = h.ndim == 1
        h = h.contiguous() if shared else _expand(h, s[..., None]).contiguous()
        q_out, p_out = (torch.full((*batch, steps + 1, self.dof), torch.nan, dtype=self.dtype) for _ in "qp")
        s_out, sigma = (torch.full((*batch, steps + 1), torch.nan, dtype=self.dtype) for _ in range(2))
        residual = torch.full((*batch, steps), torch.nan, dtype=self.dtype)
        status = torch.full((*batch, steps), int(Status.DIVERGED), dtype=torch.uint8)
        inputs = [x.contiguous() for x in (q, p, s)]
        outputs = (q_out, p_out, s_out, sigma, status, residual)
        self._call("herglotz_rollouts", s.numel(), steps, *inputs, h, 0 if shared else steps, 1, *outputs)
        return Rollout(q_out, p_out, s_out, sigma, status, residual)

    def _call(self, function: str, *arguments: Tensor | int) -> None:
        converted = (ctypes.c_void_p(x.data_ptr()) if isinstance(x, Tensor) else ctypes.c_long(x) for x in arguments)
        getattr(self._library, function)(*converted)

    def _check(self, q: Tensor, p: Tensor, s: Tensor) -> None:
        check_state(q, p, s, self.dof, self.dtype)
        for name, x in (("q", q), ("p", p), ("s", s)):
            if x.device.type != "cpu" or x.requires_grad:
                raise InputError(
                    f"{name} must be on the CPU and without gradient; use Stepper, or {name}.detach().cpu()"
                )


def _expand(h: Tensor, like: Tensor) -> Tensor:
    """H for every sample."""
    shape = (*like.shape[:-1], h.shape[-1]) if like.ndim and like.shape[-1] == 1 and h.ndim == like.ndim else like.shape
    try:
        return h.expand(shape)
    except RuntimeError:
        raise InputError(f"h must be a scalar or match the batch {tuple(shape)}, got shape {tuple(h.shape)}") from None


def compile_c(
    source: PathLike | ContactLagrangian,
    *,
    h: float = 1.0,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    dtype: str | None = None,
) -> CompiledStepper:
    """Compile a header that `export_c` wrote, or a model directly, and load it.

    The library is kept in ~/.cache/herglotz/c (or $XDG_CACHE_HOME) by the hash of its source, the compiler and the
    processor. The compiler is $CC, or cc, gcc or clang from the PATH.

    Parameters
    ----------
    source
        A header, or a model.
    h, box, units, dtype
        As in `export_c`, for a model only; dtype defaults to the model's.

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
        return CompiledStepper(read_bytes(source).decode("utf-8", "replace"), source)
    dtype = dtype or str(next(source.parameters()).dtype).removeprefix("torch.")
    with tempfile.TemporaryDirectory(prefix="herglotz-") as folder:
        path = export_c(source, Path(folder, "stepper.h"), h=h, box=box, units=units, dtype=dtype)
        return CompiledStepper(path.read_text(), "compiled model")
