"""`verify`: every identity of a contact integrator, measured on any target; `symmetries`: those of its L_d."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian, Forces
from herglotz.stepping import State
from herglotz.theory import Symmetries, TimeDependent, symmetries as of_lagrangian
from herglotz.theory.symmetries import PRECISION
from herglotz.threads import one_thread
from herglotz.training import Run
from herglotz.verify.action import Fan, derivatives, fan, hamilton_jacobi, left_hamilton_jacobi, time_form
from herglotz.verify.data_checks import data_checks
from herglotz.verify.legendre import (
    NO_H_MINUS,
    NO_H_PLUS,
    forces,
    hamiltonians_exist,
    holding,
    left_formalism,
    momentum_matching,
    regularity,
)
from herglotz.verify.report import Check, Report
from herglotz.verify.sampled_rollout import (
    SampledRollout,
    contact,
    convergence,
    derivative,
    positive_factor,
    rounded,
    sampled_rollout,
    volume,
    worst,
)
from herglotz.verify.subject import DIFFERENCED, Subject, subject

# Bounds of the contact property, relative to the terms that cancel. Measured: 2e-13 on models, and 8e-13 on the
# parachute, whose Newton tolerance, 64 eps of q ≈ 100 m, is large for steps of 0.1 m. Null models exceed 1e-3.
CONTACT = {torch.float64: 1e-11, torch.float32: 5e-4}
# Bounds of the other identities; docs/verification.md lists the measured values.
IDENTITY = {torch.float64: 1e-10, torch.float32: 1e-3}
NO_CONTACT_MAP = (
    "A map with friction or inputs is no contact map: the other checks need the model's forces (--against RUN)"
)


@one_thread()
@torch.inference_mode(mode=False)
def verify(
    target: Any,
    *,
    h: float | None = None,
    samples: int | None = None,
    steps: int = 8,
    seed: int = 0,
    tolerance: float | None = None,
    model: DiscreteLagrangian | None = None,
) -> Report:
    """Measure, on one target, the identities that the flow of every discrete contact Lagrangian satisfies.

    Rollouts of `steps` steps from `samples` states give convergence, c > 0, DΦ̃ᵀη = cη, det DΦ̃ = c^{n+1}, momentum
    matching and regularity. Fans of solutions give D2S^k = p_k, D1S^k = −σ_k p̂0, 1 + D3S^k = σ_k and the discrete
    Hamilton–Jacobi equation. A known L_d adds the left Hamilton equations and the left Hamilton–Jacobi equation, a
    scene with an exact L_d its closed-form flow, a run its data, and a time-dependent L_d (`theory.TimeDependent`),
    which steps at its own times, the form η + E dt. The step of an L_d with forces is not a contact map: DΦ̃ᵀη = cη −
    F⁻dq0 − F⁺dq1 is measured, and the checks of generating functions are left out. `herglotz.verify.legendre`
    judges coordinates that set-valued friction holds.

    Parameters
    ----------
    target
        A scene or its name, a run or its folder, an exported stepper or its file, an L_d with `h`, whose states are
        drawn, or a pair (L_d, states) or (stepper, states), with states (q, p, s) of shapes (B, n), (B, n), (B,).
    h
        Step, in the target's unit of time; by default that of the target. Required for an L_d and for a pair.
    samples, steps, seed
        Number of states (by default 64, and fewer beyond 10 coordinates), number of steps from each state, and seed of
        the drawn states.
    tolerance
        Bound on every identity, relative to the size of its terms. The defaults are 1e-11 (contact, with L_d) and 1e-10
        in float64, 5e-4 and 1e-3 in float32, and 1e-9 and 2e-3 for a file without derivatives (machine code, C beyond 8
        coordinates), whose map is differentiated by finite differences.
    model
        The model from which a file was exported. The map of a forced file is no contact map, and its steps do not
        determine the forces: with the model the file is checked as a forced map, otherwise by the checks that need no
        forces.

    Returns
    -------
    Report
        One check for each claim. Samples near a caustic are left out and counted; a check without any sample fails.

    Raises
    ------
    InputError
        If the target or a setting is not usable.

    Source: sections 1–3 of `docs/mathematics.md`, errata E4–E7.
    """
    if steps < 2:
        raise InputError(f"steps must be >= 2, got {steps}; momentum matching joins two")
    known = subject(target, h, samples, seed)
    strict, identity = _bounds(known, tolerance)
    details = _details(known, steps, seed)
    w = sampled_rollout(known, steps)
    if isinstance(known.L_d, TimeDependent):
        of_time = _of_a_map_in_time(known, w, strict, identity, fan(known, steps, seed + 1))
        return Report(known.name, tuple(of_time), details)
    behind = replace(known, L_d=model) if known.forced else known
    force = forces(behind, w)
    checks = [convergence(w), positive_factor(w), regularity(known, w)]
    missing: tuple[str, ...] = ()
    # A differenced DΦ̃ cannot be compared with differences.
    if not known.differenced:
        checks.append(derivative(known, w))
    if force is not None:
        checks += _of_a_forced_map(behind, w, strict, identity, force)
    elif known.forced:
        missing = ("contact", "momentum", *(("holding",) if known.sticks else ()))
        checks[2] = replace(checks[2], note=f"{checks[2].note}. {NO_CONTACT_MAP}")
    else:
        loose = (strict, identity) if tolerance is not None else (rounded(strict, w), rounded(identity, w))
        checks += _of_a_contact_map(known, w, identity, loose, fan(known, steps, seed + 1))
    if known.scene is not None and known.scene.exact:
        checks.append(_exact_flow(known, w, identity))
    if known.run is not None:
        more, details["data"] = data_checks(known.run)
        checks += more
    return Report(known.name, tuple(checks), details, missing)


def _bounds(known: Subject, tolerance: float | None) -> tuple[float, float]:
    """Bounds of the contact property and of the other identities."""
    if tolerance is not None and not tolerance > 0:
        raise InputError(f"tolerance must be > 0, got {tolerance}")
    dtype = known.states.q.dtype
    if dtype not in IDENTITY:
        raise InputError(f"states must be float32 or float64, got {dtype}; convert them with .double()")
    if tolerance is not None:
        return tolerance, tolerance
    identity = (DIFFERENCED if known.differenced else IDENTITY)[dtype]
    return identity if known.L_d is None else CONTACT[dtype], identity


def _of_a_forced_map(known: Subject, w: SampledRollout, strict: float, bound: float, force: Forces) -> list[Check]:
    """The identities of a map with forces, which has no generating function; its volume factor is not c^{n+1}."""
    checks = [contact(w, strict, force), momentum_matching(known, w, bound)]
    return checks if force.held is None else [*checks, holding(known, w, bound)]


def _of_a_contact_map(
    known: Subject, w: SampledRollout, bound: float, loose: tuple[float, float], f: Fan
) -> list[Check]:
    """The identities of a map without forces.

    The rounding of q enters the contact property and other identities of p, whose bounds are the two of `loose`.
    """
    right, left = hamiltonians_exist(known, w)
    checks = [contact(w, loose[0]), volume(w, bound), momentum_matching(known, w, bound)]
    checks += derivatives(f, loose[1], bound)
    checks.append(hamilton_jacobi(known, f, bound) if right else NO_H_PLUS)
    if known.L_d is None:
        return checks
    if not left:
        return [*checks, *NO_H_MINUS]
    return [*checks, left_formalism(known, w, loose[1]), left_hamilton_jacobi(known, f, bound)]


def _of_a_map_in_time(known: Subject, w: SampledRollout, strict: float, bound: float, f: Fan) -> list[Check]:
    """The identities of steps of a time-dependent L_d, of which step k begins at t_k = t0 + kh."""
    checks = [convergence(w), positive_factor(w), contact(w, strict), volume(w, bound), time_form(known, w, bound)]
    checks += [momentum_matching(known, w, bound), *derivatives(f, bound, bound)]
    return [*checks, hamilton_jacobi(known, f, bound), left_hamilton_jacobi(known, f, bound)]


def _details(known: Subject, steps: int, seed: int) -> dict[str, Any]:
    return {
        "kind": known.kind,
        "dof": known.dof,
        "dtype": str(known.states.q.dtype).removeprefix("torch."),
        "h": known.h,
        "samples": len(known.states.s),
        "steps": steps,
        "seed": seed,
        "torch": str(torch.__version__),
        "not_judged": _not_judged(known),
    }


def _not_judged(known: Subject) -> str:
    """A sentence on what the table does not judge."""
    if known.run is not None:
        return "whether p, s and γ are true, other h, and motions unlike the recorded ones."
    if known.scene is not None and known.scene.exact:
        return "other parameters and states than these."
    physics = "whether the motion is that of the physical system"
    return f"{physics}: the rows hold for every regular L_d, at this h alone."


def _exact_flow(known: Subject, w: SampledRollout, bound: float) -> Check:
    """Check that every step equals the closed-form flow, relative to the largest q, p and s."""
    assert known.scene is not None
    with torch.no_grad():
        flow = known.scene.flow(*w.starts, known.h)
    sizes = (float(x.abs().max()) for x in (w.q, w.p, w.s))
    value = max(worst((x - y).abs()) / size for x, y, size in zip(w.ends, flow, sizes, strict=True))
    return Check.at_most("exact_flow", "exact L_d: a step is the closed-form flow", value, bound)


# Standard deviation of the offset added to p, relative to that of p.
MOMENTUM_SPREAD = 0.3
# J of a symmetry is constant within this many RMS errors of the free run.
RMS_ERRORS = 3.0
# Steps of a motion by default.
STEPS = 40
# Largest number of steps of a motion over the unseen part of a recording.
MAX_UNSEEN_STEPS = 200


@one_thread()
@torch.inference_mode(mode=False)
def symmetries(
    target: Any,
    *,
    h: float | None = None,
    samples: int | None = None,
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
