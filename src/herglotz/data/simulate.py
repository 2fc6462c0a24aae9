"""Sampled motions of a scene, with noise and gaps; the same seed gives the same numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from herglotz.data.checks import DTYPES, MIN_SAMPLES, check_positive
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, check_whole

if TYPE_CHECKING:
    from herglotz.scenes import Scene

# Consecutive samples that one gap deletes at most.
LONGEST_GAP = 3
Range = tuple[float | Sequence[float] | Tensor, float | Sequence[float] | Tensor]
# The remedy for an L_d in place of a scene.
OF_AN_L_D = (
    "motions of an L_d are stepped: out = hz.Stepper(L_d).rollout(q, p, s, h=0.1, steps=100); "
    "data of one of them: hz.Trajectories.of(0.1 * torch.arange(101), out.q[0])"
)


def simulate(
    scene: Scene | str,
    *,
    trajectories: int = 4,
    steps: int = 100,
    h: float | None = None,
    noise: float = 0.0,
    gaps: int = 0,
    seed: int = 0,
    q_range: Range | None = None,
    v_range: Range | None = None,
    keep_state: bool = False,
    dtype: torch.dtype = torch.float64,
) -> Trajectories:
    """Sample motions of a scene from uniform random initial positions and velocities and s = 0.

    A scene with inputs is driven by its own u(t): the value in the middle of a step is held over that step. These
    inputs are stored; a step across a gap stores the mean of the inputs inside it.

    All numbers are drawn and computed in float64 from one `torch.Generator`; `dtype` only converts the result.

    Parameters
    ----------
    scene
        What moves: a scene (`herglotz.scene`), or the name of one with its usual parameters.
    trajectories
        Number of motions B.
    steps
        Of each trajectory: steps + 1 samples before gaps.
    h
        Time between samples, in the scene's unit of time; left out: the scene's own step.
    noise
        Standard deviation of Gaussian noise on q, in its units.
    gaps
        Runs of 1 to 3 consecutive interior samples deleted from each trajectory.
    seed
        Of starts, noise and gaps; the same seed gives the same numbers.
    q_range, v_range
        (lowest, highest) initial position and velocity, a number or one a coordinate; left out: the scene's.
    keep_state
        Also store s and p, without noise.
    dtype
        Of the result, torch.float64 or torch.float32.

    Returns
    -------
    Trajectories
        q (N, n) in the scene's units, and u (N, m) of a driven scene.

    Raises
    ------
    InputError
        If there is no such scene, an argument is out of range, or the motion leaves the finite numbers.
    """
    if isinstance(scene, str):
        # Imported here because a fit needs no scene.
        from herglotz.scenes import scene as scene_named

        scene = scene_named(scene)
    if not hasattr(scene, "dof"):
        raise InputError(f"simulate takes a scene, got a {type(scene).__name__}; {OF_AN_L_D}")
    h = scene.h if h is None else h
    _check_counts(trajectories, steps, gaps, seed)
    check_positive("h", h)
    if not 0.0 <= noise < float("inf"):
        raise InputError(f"noise must be finite and >= 0, got {noise}")
    if dtype not in DTYPES:
        raise InputError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
    generator = torch.Generator().manual_seed(seed)
    shape = (trajectories, scene.dof)
    q0 = uniform("q_range", scene.q_range if q_range is None else q_range, shape, generator)
    v0 = uniform("v_range", scene.v_range if v_range is None else v_range, shape, generator)
    drive = getattr(scene, "drive", None)
    middles = h * (torch.arange(steps + 1, dtype=torch.float64) + 0.5)
    u = None if drive is None else drive(middles)  # (steps + 1, m)
    q, p, s = _roll(scene, q0, v0, steps, h, u)
    q = q + noise * torch.randn(q.shape, generator=generator, dtype=q.dtype)
    keep = torch.stack([_kept(steps + 1, gaps, generator) for _ in range(trajectories)])  # (B, steps + 1) bool
    more: dict[str, Any] = {"s": s.flatten(), "p": p.flatten(0, 1)} if keep_state else {}
    more |= {} if u is None else {"u": u.repeat(trajectories, 1), "hold": "zero"}
    whole = Trajectories(
        (h * torch.arange(steps + 1, dtype=torch.float64)).repeat(trajectories),
        q.flatten(0, 1),
        (steps + 1,) * trajectories,
        names=tuple(scene.coordinates),
        units=tuple("rad" if a else unit for a, unit in zip(scene.angles, scene.units, strict=True)),
        angles=tuple(scene.angles),
        **more,
        time_unit=getattr(scene, "time_unit", "s"),
        source=f"simulate({scene.name}, h={h:g}, seed={seed})",
    )
    return whole.keep(keep.flatten()).to(dtype=dtype)


def _roll(scene: Any, q: Tensor, v: Tensor, steps: int, h: float, u: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Apply the flow at each step's inputs (steps + 1, m); return q, p (B, steps + 1, n) and s (B, steps + 1)."""
    s = torch.zeros(len(q), dtype=q.dtype)
    p, step = scene.momentum(q, v, s), torch.tensor(h, dtype=q.dtype)
    states = [(q, p, s)]
    with torch.no_grad():
        for k in range(steps):
            now = scene if u is None else scene.at(u[k])
            q, p, s = now.flow(q, p, s, step)
            bad = ~(torch.isfinite(q).all(-1) & torch.isfinite(p).all(-1) & torch.isfinite(s))
            if bad.any():
                raise InputError(
                    f"{scene.name}: trajectory {int(bad.nonzero()[0])} is not finite after step {k + 1} of h={h:g}; "
                    "narrow q_range or v_range, or take fewer or shorter steps"
                )
            states.append((q, p, s))
    qs, ps, ss = zip(*states, strict=True)
    return torch.stack(qs, 1), torch.stack(ps, 1), torch.stack(ss, 1)


def _kept(samples: int, gaps: int, generator: torch.Generator) -> Tensor:
    """Delete `gaps` separate runs of 1 to 3 interior samples; return which samples stay, (samples,) bool."""
    runs = torch.randint(1, LONGEST_GAP + 1, (gaps,), generator=generator)
    left = samples - int(runs.sum())
    # Each run goes into its own slot between two samples that stay: no run is at an end, and no two runs touch.
    slots = torch.randperm(left - 1, generator=generator)[:gaps]
    missing_before = torch.zeros(left, dtype=torch.long)
    missing_before[slots + 1] = runs
    keep = torch.zeros(samples, dtype=torch.bool)
    keep[torch.arange(left) + missing_before.cumsum(0)] = True
    return keep


def uniform(name: str, limits: Range, shape: tuple[int, int], generator: torch.Generator) -> Tensor:
    """Positions or velocities (B, n) drawn uniformly between limits that are numbers or n numbers each."""
    try:
        low, high = (torch.as_tensor(x, dtype=torch.float64).expand(shape) for x in limits)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{name} must be (low, high), numbers or {shape[1]} numbers each, got {limits!r}") from error
    if not bool(((low <= high) & torch.isfinite(high - low)).all()):
        raise InputError(f"{name} must be finite with low <= high, got {limits!r}")
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def _check_counts(trajectories: int, steps: int, gaps: int, seed: int) -> None:
    check_whole(1, trajectories=trajectories)
    check_whole(2, steps=steps)
    check_whole(0, gaps=gaps, seed=seed)
    shortest = steps + 1 - LONGEST_GAP * gaps
    if shortest < max(MIN_SAMPLES, gaps + 1):
        raise InputError(
            f"{gaps} gaps of up to {LONGEST_GAP} samples do not fit into {steps + 1} samples; "
            "take fewer gaps or more steps"
        )
