"""The symmetries of a scene, a run or an L_d: `theory.symmetries` with sample states and a precision."""

from __future__ import annotations

from typing import Any

import torch

from herglotz.errors import InputError
from herglotz.stepping import State
from herglotz.theory import Symmetries, symmetries as of_lagrangian
from herglotz.theory.symmetries import PRECISION
from herglotz.threads import one_thread
from herglotz.training import Run
from herglotz.verify.subject import subject

# Standard deviation of the offset added to p, relative to that of p.
MOMENTUM_SPREAD = 0.3
# J of a symmetry is constant within this many RMS errors of the free run.
RMS_ERRORS = 3.0
# Steps of a motion by default.
STEPS = 40
# Largest number of steps of a motion over the unseen part of a recording.
MAX_UNSEEN_STEPS = 200


@one_thread()
def symmetries(
    target: Any,
    *,
    h: float | None = None,
    samples: int = 64,
    steps: int | None = None,
    seed: int = 0,
    precision: float | None = None,
) -> Symmetries:
    """Find the affine point symmetries of a target, and the quantities J with J_{k+1} = c_k J_k.

    Parameters
    ----------
    target, h, samples, seed
        As for `herglotz.verify.verify`: a scene or its name, a run or its folder, an L_d with h, or (L_d, states).
    steps
        Steps of each motion; by default 40, for a run those of the unseen part, at most 200.
    precision
        Largest drift of a symmetry, by default 1e-9. For a run the default is three times the RMS error of the free run
        over the unseen part, or the training part if nothing is unseen, relative to the RMS size of the motion, if that
        is more than 1e-9.

    Returns
    -------
    herglotz.theory.Symmetries
        `print` names each symmetry.

    Raise InputError if the target has no L_d, such as an exported file, or its motions cannot be stepped.
    """
    known = subject(target, h, samples, seed)
    states = known.states
    if known.L_d is None:
        raise InputError(f"{known.name}: has no L_d to look into; give the run that was exported")
    angles: tuple[bool, ...] = ()
    names: tuple[str, ...] = ()
    length = STEPS
    if known.scene is not None:
        angles, names = known.scene.angles, known.scene.coordinates
    if known.run is not None:
        angles, names = known.run.data.angles, known.run.data.names
        length = _unseen_steps(known.run)
        precision = precision or max(_precision(known.run), PRECISION[states.q.dtype])
        states = _opened(states, torch.Generator().manual_seed(seed))
    return of_lagrangian(
        known.L_d,
        states,
        torch.tensor(known.h, dtype=states.q.dtype),
        steps=length if steps is None else steps,
        precision=precision,
        angles=angles,
        coordinates=names,
    )


def _opened(states: State, make: torch.Generator) -> State:
    """The states with an offset of p: on the recorded motions alone J may have a single value."""
    q, p, s = states
    offset = torch.randn(p.shape, generator=make, dtype=torch.float64).to(p)
    return State(q, p + MOMENTUM_SPREAD * p.std(0, correction=0) * offset, s)


def _unseen_steps(run: Run) -> int:
    """Model steps of the longest unseen part, at most `MAX_UNSEEN_STEPS`; `STEPS` if nothing is unseen."""
    unseen = max(length - seen for length, seen in zip(run.data.lengths, run.train_lengths, strict=True))
    return min(unseen * run.decided.substeps, MAX_UNSEEN_STEPS) or STEPS


def _precision(run: Run) -> float:
    """`RMS_ERRORS` errors of the free run, unseen or else training part, over the RMS size of the motion."""
    errors = (run.metrics.get(name) for name in ("extrapolation_rms", "train_rms"))
    error = next((x for x in errors if x is not None), None)
    spread = run.metrics.get("spread")
    if error is None or not spread:
        raise InputError("the run does not say how precise it is; give precision=, the largest drift of a symmetry")
    return RMS_ERRORS * error / spread
