"""`reason_of`: why a model does not fit, as far as the residual shows, in words.

Free runs of 20 recorded steps, whose starts are fitted, leave a residual. The curvature of parabolas through nine
samples of the residual is the acceleration that the model lacks, known to the noise of the data. Five reasons are
looked for:

* positions on a circle, which one angle gives, or a distance from its centre that changes;
* an acceleration of something else, a crane's trolley, that was left aside;
* an input that was recorded more slowly than the motion and filled in: its steps act at times between rows;
* the past: the lacking accelerations differ where positions, velocities and inputs of two times are alike, so that no
  function of these gives the accelerations;
* kicks: the same, and a twentieth of the samples has more than half of the sum of squares.
"""

from __future__ import annotations

import shlex
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.column_roles import is_of_others
from herglotz.data.polar import LENGTH, with_hints
from herglotz.data.rates import filled_inputs
from herglotz.data.roughness import SAMPLES, precisions
from herglotz.data.units import size

# Most samples: the distances between all of them take 32 MB.
MOST = 2000
# Fewest accelerations: a twentieth of them is one.
FEW = 20
# Largest distance of neighbours, in standard deviations of the state: forces of a narrow range differ farther apart.
NEAR = 0.5
# The state does not give the acceleration if neighbours differ by more than this share of the variance without noise.
# Measured: laws with a memory, and forces that were not recorded, 0.2 to 2; forces of the state that were left out at
# most 0.11.
OTHER = 0.15
# The same over the noise: curvatures of windows that share samples differ by 1.5 times the noise by chance.
CLEAR = 2.0


def reason_of_data(data: Trajectories) -> str:
    """The reason of a misfit that the data themselves show, and what to try; "" where they show none."""
    if hints := with_hints(replace(data, notes=())).notes:
        return hints[0].removeprefix("warning: ")
    if changes := [note.removeprefix("warning: ") for note in data.notes if LENGTH in note]:
        return changes[0][0].upper() + changes[0][1:]
    if others := [x for x, role, unit in data.columns if role == "left aside" and is_of_others(unit, data.units)]:
        verb, they = ("was", "it is") if len(others) == 1 else ("were", "they are")
        names = ",".join([*(x for x, role, _ in data.columns if role == "input"), *others])
        return f"{', '.join(others)} {verb} left aside, and {they} of no coordinate. Try --inputs {shlex.quote(names)}"
    if names := filled_inputs(data):
        some, was, its = ("input", "was", "its") if len(names) == 1 else ("inputs", "were", "their")
        return (
            f"The {some} {', '.join(names)} {was} recorded more slowly than the motion and filled in, and {its} steps "
            "act at times between rows. Try the records of both before they were merged, or blank cells where nothing "
            "was recorded"
        )
    return ""


def reason_of(
    data: Trajectories,
    miss: Tensor,  # (N, n) residual at the samples, in units of q
    owner: Tensor,  # (N,) free run of each sample
) -> str | None:
    """The reason of a misfit, and what to try, in sentences; "" where none is shown, None where noise hides it."""
    first = torch.arange(max(0, data.samples - SAMPLES + 1), device=data.t.device)
    first = first[owner[first] == owner[first + SAMPLES - 1]]
    if len(first) < FEW:
        return ""
    rows = first[:, None] + torch.arange(SAMPLES, device=data.t.device)
    h = data.t[rows].diff(dim=1).mean(1)[:, None]
    place = torch.arange(SAMPLES).to(data.q) - SAMPLES // 2
    value, slope, bend = torch.linalg.pinv(torch.stack([place**0, place, place**2 / 2], -1))
    at = lambda weights, x: (weights[:, None] * x[rows]).sum(1)  # noqa: E731
    noise = precisions(data).to(data.q) * data.balance * bend.norm() / h**2
    lacking = at(bend, miss) / h**2
    lacking, noise = lacking / lacking.std(0), noise / lacking.std(0)
    q, turning = at(value, data.q), torch.tensor(data.angles, device=miss.device)
    state = [q[:, ~turning], q[:, turning].sin(), q[:, turning].cos(), at(slope, data.q) / h]
    state += [] if data.u is None else [at(value, data.u)]
    x = torch.cat(state, 1)
    middle = rows[:, SAMPLES // 2]
    hidden = float(noise.square().mean())
    if not _is_other(lacking, hidden, x / x.std(0).clamp_min(1e-300), middle):
        return None if hidden > OTHER else ""
    if (kick := _kick(lacking)) is not None:
        row, unit = int(middle[kick]), "" if data.time_unit == "1" else data.time_unit
        when = f"t = {size(float(data.t[row]), unit)} of trajectory {int(data.trajectory[row])}"
        return (
            f"What is missed comes in kicks, the hardest at {when}. Try what strikes as an input (--inputs), or "
            "recordings that are cut there"
        )
    return (
        "It misses differently where positions, velocities and inputs are alike: the force depends on the past, or on "
        "what was not recorded. Try --level full, whose action remembers, or record what else acts (--inputs)"
    )


def _kick(lacking: Tensor) -> int | None:
    """Row of the largest acceleration of (K, n), if the accelerations are kicks; else None."""
    square = lacking.square().sum(1)
    top = square.argsort(descending=True)[: len(square) // FEW]
    return int(top[0]) if float(square[top].sum()) > 0.5 * float(square.sum()) else None


def _is_other(lacking: Tensor, noise: float, x: Tensor, row: Tensor) -> bool:
    """Whether accelerations (K, n) of variance 1 differ where states x (K, m) of other times are alike.

    `noise` is the share of the variance that is noise. The quarter of the samples with the nearest neighbours counts.
    """
    apart = torch.cdist(x, x).masked_fill((row[:, None] - row).abs() < 2 * SAMPLES, torch.inf)
    distance, other = apart.min(1)
    near = distance.argsort()[: max(1, len(x) // 4)]
    if not float(distance[near[-1]]) < NEAR:
        return False
    differ = float((lacking[near] - lacking[other[near]]).square().mean()) / 2
    return differ > max(CLEAR * noise, noise + OTHER * (1 - noise))
