"""An exported `.pt2` file as a stepper with the interface of `herglotz.stepping.Stepper`."""

from __future__ import annotations

import io
import json
import logging
import math
from typing import Any

import torch
from torch import Tensor

from herglotz.data.files import PathLike, read_bytes
from herglotz.errors import InputError
from herglotz.export.inputs import check_state, checked_h
from herglotz.export.pt2 import FORMAT, METADATA
from herglotz.stepping import Rollout, State, Step, step_sizes

REQUIRED = ("format", "dof", "dtype", "h", "box", "newton_iterations", "newton_tolerance")


class ExportedStepper:
    """The flow Φ̃ of an exported model; results are those of `Stepper`, differentiable in the state.

    Parameters
    ----------
    module
        What `torch.export.load(path).module()` gives.
    metadata
        The file's own description: model, dof, dtype, h, units, angles, box, versions, weights_sha256.
    path
        Where it came from, for messages.
    """

    def __init__(self, module: torch.nn.Module, metadata: dict[str, Any], path: str = "exported model"):
        self.module = module
        self.metadata = metadata
        self.path = path
        self.dof: int = metadata["dof"]
        self.dtype: torch.dtype = getattr(torch, metadata["dtype"])
        self.h: float = metadata["h"]

    def step(self, state: State, h: Tensor | float) -> Step:
        """One step.

        Parameters
        ----------
        state
            (q, p, s) with shapes (..., n), (..., n), (...), in the dtype of the file.
        h
            Time step > 0, scalar or (...).

        Returns
        -------
        Step
            NaN in the samples whose status is not `Status.CONVERGED`.

        Raises
        ------
        InputError
            If a shape, the dtype or a value is not what the file takes.
        """
        q, p, s = state
        check_state(q, p, s, self.dof, self.dtype)
        return self._step(state, checked_h(h, self.dtype))

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
        check_state(q, p, s, self.dof, self.dtype)
        h_all = step_sizes(checked_h(h, self.dtype), steps)
        states, results = [State(q, p, s)], []
        for k in range(h_all.shape[-1]):
            results.append(self._step(states[-1], h_all[..., k]))
            states.append(results[-1].state)
        return Rollout.of(states, results)

    def outside_box(self, state: State) -> Tensor:
        """(...) True where a state lies outside the box the model was fitted in; angles count modulo 2π.

        Raises
        ------
        InputError
            If the file records no box.
        """
        box = self.metadata["box"]
        if box is None:
            raise InputError(f"{self.path}: records no box; export it again with box=")
        bounds = {key: torch.tensor(values, dtype=self.dtype, device=state.q.device) for key, values in box.items()}
        middle = (bounds["q_low"] + bounds["q_high"]) / 2
        turns = torch.round((state.q - middle) / (2 * math.pi))
        angles = torch.tensor(self.metadata.get("angles", [False] * self.dof), device=state.q.device)
        q = torch.where(angles, state.q - 2 * math.pi * turns, state.q)
        outside = torch.zeros_like(state.s, dtype=torch.bool)
        for name, x in (("q", q), ("p", state.p), ("s", state.s[..., None])):
            inside = (x >= bounds[f"{name}_low"]) & (x <= bounds[f"{name}_high"])
            outside = outside | ~inside.all(-1)
        return outside

    def _step(self, state: State, h: Tensor) -> Step:
        q, p, s = state
        fits = h.ndim <= s.ndim and all(a in (1, b) for a, b in zip(h.shape[::-1], s.shape[::-1], strict=False))
        if not fits:
            raise InputError(f"h must be a scalar or match the batch {tuple(s.shape)}, got shape {tuple(h.shape)}")
        flat = (q.reshape(-1, self.dof), p.reshape(-1, self.dof), s.reshape(-1), h.expand(s.shape).reshape(-1))
        q1, p1, s1, c, residual, status = self.module(*(x.contiguous() for x in flat))
        new = State(q1.reshape(q.shape), p1.reshape(q.shape), s1.reshape(s.shape))
        c, residual, status = (x.reshape(s.shape) for x in (c, residual, status))
        return Step(new, c, status, residual, self.metadata["newton_iterations"])


def load_pt2(path: PathLike) -> ExportedStepper:
    """Read a file that `export_pt2` wrote.

    Raises
    ------
    InputError
        If the file is missing, damaged, not one of ours, or of another format version.
    """
    content = read_bytes(path)
    extra = {METADATA: ""}
    log = logging.getLogger("torch.export")
    level = log.level
    log.setLevel(logging.CRITICAL)  # torch logs a traceback of its own for a damaged file; one line is enough
    try:
        module = torch.export.load(io.BytesIO(content), extra_files=extra).module()
    except Exception as error:  # torch raises whatever its zip, JSON and graph readers raise
        line = str(error).strip().splitlines() or [""]
        raise InputError(
            f"{path}: is not a readable .pt2 file ({type(error).__name__}: {line[0][:120]}); export the model again"
        ) from error
    finally:
        log.setLevel(level)
    return ExportedStepper(module, _read_metadata(extra[METADATA], path), str(path))


def _read_metadata(text: str, path: PathLike) -> dict[str, Any]:
    try:
        metadata = json.loads(text)
    except json.JSONDecodeError:
        metadata = None
    if not isinstance(metadata, dict) or any(key not in metadata for key in REQUIRED):
        raise InputError(f"{path}: has no herglotz metadata; write it with herglotz.export.export_pt2")
    if metadata["format"] != FORMAT:
        raise InputError(
            f"{path}: is of format {metadata['format']}, this herglotz reads {FORMAT}; export the model again"
        )
    return metadata
