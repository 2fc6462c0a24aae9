"""Exported files as steppers with the interface of `herglotz.stepping.Stepper`, whatever their format."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.export.box import Box
from herglotz.export.inputs import check_every, check_inputs, check_range, check_state, checked_h, decimated, spread_h
from herglotz.stepping import Linearised, Rollout, State, Status, Step, step_sizes
from herglotz.stepping.state import check_started

Program = Callable[..., tuple[Tensor, ...]]


class ExportedStepper:
    """The flow Φ̃ of an exported model; results are those of `Stepper`.

    Parameters
    ----------
    programs
        What the file can run, each a function of contiguous tensors: `rollout` (q, p, s, h (K, B)[, u]) → K steps, and
        where the format has them `model`, one differentiable step, and `init`.
    metadata
        The file's own description: model, dof, dtype, h, units, angles, box, versions, weights_sha256.
    path
        Where it came from, for messages.
    kind
        "pt2", "aoti" or "onnx".
    """

    def __init__(
        self, programs: Mapping[str, Program], metadata: dict[str, Any], path: str = "exported model", kind: str = "pt2"
    ):
        self.programs = dict(programs)
        self.metadata = metadata
        self.path = path
        self.kind = kind
        self.dof: int = metadata["dof"]
        self.inputs: int = metadata.get("inputs", 0)
        self.dtype: torch.dtype = getattr(torch, metadata["dtype"])
        self.h: float = metadata["h"]
        box = metadata["box"]
        self._box = None if box is None else Box(box, metadata.get("angles", [False] * self.dof), self.dtype)

    @property
    def differentiable(self) -> bool:
        """Whether autograd goes through `step`."""
        return "model" in self.programs

    def init(
        self, q0: Tensor, q1: Tensor, s0: Tensor | None = None, h: Tensor | float = 1.0, u: Tensor | None = None
    ) -> State:
        """The state (q1, p1, s1) = FL⁺(q0, q1, s0) from two positions h apart; s0 defaults to 0.

        Raises
        ------
        InputError
            As `step`, and where the format holds no such program.
        """
        if "init" not in self.programs:
            raise InputError(f"{self.path}: an {self.kind} file starts from (q, p, s) only; use a .pt2 file for init")
        s0 = torch.zeros_like(q0[..., 0]) if s0 is None else s0
        self._check(q0, q1, s0, ("q0", "q1", "s0"))
        h = self._checked_h(h)
        p, s = self.programs["init"](*self._flat(State(q0, q1, s0), spread_h(h, s0), u))
        return check_started(State(q1, p.reshape(q1.shape), s.reshape(s0.shape)))

    def step(self, state: State, h: Tensor | float, u: Tensor | None = None) -> Step:
        """One step.

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...), in the dtype of the file.
        h
            Time step > 0, scalar or (...).
        u
            (..., m) inputs, for a model that takes some; None: no input acts.

        Returns
        -------
        Step
            NaN in the samples whose status is not `Status.CONVERGED`. `iterations` is the bound, not a count.

        Raises
        ------
        InputError
            If a shape, the dtype or a value is not what the file takes.
        """
        q, p, s = state
        self._check(q, p, s)
        h = spread_h(self._checked_h(h), s)
        flat = self._flat(state, h, u)
        if "model" in self.programs:
            out = self.programs["model"](*flat)
        else:
            out = tuple(x[0] for x in self.programs["rollout"](*flat[:3], *(x[None] for x in flat[3:])))
        return self._step(out, state)

    def _step(self, out: Sequence[Tensor], state: State) -> Step:
        """The outputs of a program as a step of the shape of `state`."""
        q, _, s = state
        q1, p1, s1, c, residual, status, *outside = out
        new = State(q1.reshape(q.shape), p1.reshape(q.shape), s1.reshape(s.shape))
        c, residual, status, *outside = (x.reshape(s.shape) for x in (c, residual, status, *outside))
        return Step(new, c, status, residual, self.metadata["newton_iterations"], *outside)

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
    ) -> Rollout:
        """Step K times from (q, p, s), inside the file; everything after a failed step is NaN. No derivatives.

        Parameters
        ----------
        q, p, s
            (..., n), (..., n), (...); s defaults to 0.
        h
            A scalar for equal steps, (K,) for steps shared by the batch, or (..., K).
        steps
            K; needed for a scalar h without inputs only.
        inputs
            (K, m) or (..., K, m): u_k of each step, for a model that takes some; None: no input acts.
        every
            Keep each m-th state only; m divides K. Statuses, residuals and flags are the worst of the m steps.

        Raises
        ------
        InputError
            As `step`, and if the length of h and `steps` disagree.
        """
        s = torch.zeros_like(q[..., 0]) if s is None else s
        self._check(q, p, s)
        if inputs is not None and inputs.ndim < 2:
            raise InputError(f"inputs need the shape (K, m) or (..., K, m), got {tuple(inputs.shape)}")
        if inputs is not None and steps is None and torch.as_tensor(h).ndim == 0:
            steps = inputs.shape[-2]
        h_all = step_sizes(self._checked_h(h), steps)
        steps, size = h_all.shape[-1], s.numel()
        check_every(every, steps)
        rows = [spread_h(h_all[..., k], s).reshape(-1) for k in range(steps)] if h_all.ndim > 1 else []
        h_rows = torch.stack(rows) if rows else h_all.reshape(-1, 1).expand(steps, size)
        more = tuple(x.reshape(size, steps, -1).transpose(0, 1) for x in self._inputs(inputs, (*s.shape, steps)))
        start = (q.reshape(-1, self.dof), p.reshape(-1, self.dof), s.reshape(-1))
        with torch.no_grad():
            out = self.programs["rollout"](*(_plain(x) for x in (*start, h_rows, *more)))
        q_all, p_all, s_all, c, *rest = (x.movedim(0, 1).reshape(*s.shape, *_tail(x)) for x in out)
        status, residual, outside = rest[1], rest[0], (rest[2] if len(rest) > 2 else None)
        sigma = torch.cat([torch.ones_like(s)[..., None], c], -1).cumprod(-1)
        lost = ~torch.isfinite(sigma[..., 1:])  # σ is no number of the file's: too large a one is found here
        status = torch.where(lost & (status == 0), int(Status.DIVERGED), status).to(torch.uint8)
        nan = torch.where(lost, torch.nan, torch.zeros_like(c))
        sigma = torch.cat([sigma[..., :1], sigma[..., 1:] + nan], -1)
        ends = (q_all + nan[..., None], p_all + nan[..., None], s_all + nan)
        q, p, s = (torch.cat([x.unsqueeze(s.ndim), y], s.ndim) for x, y in zip((q, p, s), ends, strict=True))
        found = Rollout(q=q, p=p, s=s, sigma=sigma, status=status, residual=residual, outside=outside)
        return decimated(found, every)

    def linearise(self, state: State, h: Tensor | float, u: Tensor | None = None) -> Linearised:
        """One step and its derivative with respect to the state, h and u, by the implicit-function theorem.

        Parameters
        ----------
        state, h, u
            As in `step`; autograd does not go through the result.

        Returns
        -------
        Linearised
            The step, d(q, p, s)′/d(q, p, s) (..., 2n+1, 2n+1), /dh (..., 2n+1) and, for a model with inputs, /du.

        Raises
        ------
        InputError
            As `step`, and where the format holds no derivative.
        """
        if "linearise" not in self.programs:
            raise InputError(f"{self.path}: an {self.kind} file holds no derivative; use a .pt2, ONNX or C file")
        state = State(*(x.detach() for x in state))
        self._check(*state)
        h = spread_h(self._checked_h(h), state.s)
        with torch.no_grad():
            *out, J = self.programs["linearise"](*self._flat(state, h, u))
        J, size = J.reshape(*state.s.shape, *J.shape[1:]), 2 * self.dof + 1
        by_input = J[..., size + 1 :] if self.inputs else None
        return Linearised(self._step(out, state), J[..., :size], J[..., size], by_input)

    def outside_box(self, state: State) -> Tensor:
        """(...) True where a state lies outside the box the model was fitted in; angles count modulo 2π.

        Raises
        ------
        InputError
            If the file records no box.
        """
        if self._box is None:
            raise InputError(f"{self.path}: records no box; export it again with box=")
        return self._box(*state)

    def _check(self, q: Tensor, p: Tensor, s: Tensor, names: tuple[str, str, str] = ("q", "p", "s")) -> None:
        check_state(q, p, s, self.dof, self.dtype, names)
        for name, x in zip(names, (q, p, s), strict=True):
            if x.device.type != "cpu":
                raise InputError(f"{name} must be on the CPU, got {x.device}; use {name}.cpu()")
            if x.requires_grad and not self.differentiable and torch.is_grad_enabled():
                raise InputError(f"an {self.kind} file has no derivatives; use a .pt2 file, or {name}.detach()")

    def _checked_h(self, h: Tensor | float) -> Tensor:
        h = checked_h(h, self.dtype)
        check_range(h, self.metadata.get("h_range"))
        return h

    def _flat(self, state: State, h: Tensor, u: Tensor | None) -> tuple[Tensor, ...]:
        """(B, n), (B, n), (B,), (B,)[, (B, m)], each with its own storage in standard layout."""
        q, p, s = state
        flat = (q.reshape(-1, self.dof), p.reshape(-1, self.dof), s.reshape(-1), h.reshape(-1))
        more = (x.reshape(len(flat[2]), -1) for x in self._inputs(u, s.shape))
        return tuple(_plain(x) for x in (*flat, *more))

    def _inputs(self, u: Tensor | None, shape: tuple[int, ...]) -> tuple[Tensor, ...]:
        """(u,) of shape (*shape, m) for a model that takes inputs, those that do not act for None; () for another."""
        if u is None:
            idle = torch.tensor(self.metadata.get("input_zero") or [0.0] * self.inputs, dtype=self.dtype)
            return (idle.expand(*shape, self.inputs),) if self.inputs else ()
        if u.ndim and u.ndim <= len(shape) + 1:
            with suppress(RuntimeError):  # left as it is, for the message below
                u = u.expand(*shape, u.shape[-1])
        check_inputs(u, self.inputs, shape, self.dtype)
        return (u,)


def _plain(x: Tensor) -> Tensor:
    """Standard layout; compiled code reads memory in that order whatever the strides say."""
    return x.contiguous() if x.requires_grad else x.clone(memory_format=torch.contiguous_format)


def _tail(x: Tensor) -> tuple[int, ...]:
    """The shape of (K, B, ...) without B."""
    return (x.shape[0], *x.shape[2:])
