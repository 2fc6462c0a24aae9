"""`reason_of`: why a model does not fit, as far as the residual shows, in words.

Free runs of 20 recorded steps, whose starts are fitted, leave a residual. The curvature of parabolas through nine
samples of the residual is the acceleration that the model lacks, known to the noise of the data. Seven reasons are
looked for:

* samples that are noise, or too far apart for the motion;
* positions on a circle, which one angle gives, or a distance from its centre that changes; counts of an encoder;
* inputs that were recorded more often than the motion, and changed within its steps;
* a column that was left aside and is the acceleration of something else, such as a crane's trolley;
* an input that was recorded more slowly than the motion and filled in: its steps act at times between rows;
* kicks, as of blows and end stops, in the residual or in the motion itself: a twentieth of the samples has more than
  half of the sum of squares, in several places with little before and after each;
* the past: the lacking accelerations differ where positions, velocities and inputs of two times are alike, so that no
  function of these gives the accelerations; or the past of the motion explains half of what these do not;
* the time, if it explains half of what the state does not, and more than the past.

What the past explains of the lacking force y that the present state does not is measured by kernel ridge regressions,
which predict y for blocks of time from the other blocks (`left_by_the_past`):

* from the state x = (q, q̇, u) alone, with k(x, x′) = exp(−|x − x′|²/2ℓ²);
* from the state and the past z, with k(x, x′) (1 + z·z′/m): sums of functions of x, and of such functions times z_j;
* from the state and the time since the start of the recording, in the same way with z = (t, t²).

The present state predicts a missing force that depends on the state. The past of a motion has m signals of each
coordinate: q̇, q̇² and q² through low-pass filters, which are the memory of springs behind dampers, of heat and of the
action; and the position lost in a play, which is the memory of hysteresis. Time predicts masses that grow or leak, and
wear.
"""

from __future__ import annotations

import math
import shlex

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.column_roles import is_of_others, is_rate_of_others, role_of
from herglotz.data.gaps import MEANS
from herglotz.data.noise import SAMPLES, precisions
from herglotz.data.polar import CIRCLE, LENGTH, circles, hint
from herglotz.data.rates import filled_inputs
from herglotz.data.smoothing import slopes
from herglotz.data.trajectories import perhaps_angles
from herglotz.data.units import COUNTS, size
from herglotz.training.following import HALF
from herglotz.training.properties import inverse, properties

# At most this many samples are compared: the distances between all of them take 32 MB.
MOST = 2000
# Fewer accelerations give no reason: a kick is looked for among a twentieth of them, which has to be one at least.
FEW = 20
# Neighbours are at most this far apart, in standard deviations of the state: forces may differ beyond.
MAX_DISTANCE = 0.5
# The state does not give the acceleration if neighbours differ by more than this share of the variance without noise.
# This share was measured: 0.2 to 2 for laws with a memory and for forces that were not recorded, at most 0.11 for
# forces of the state that a model lacks.
MAX_DIFFERENCE = 0.15
# Neighbours have to differ by more than this multiple of the noise: curvatures of windows that share samples differ by
# 1.5 times the noise by chance.
MIN_DIFFERENCE_OVER_NOISE = 2.0
# A kick has three samples, because blows of a ball that bounces follow one another within 20 samples, or five, because
# five have less noise.
KICK_SAMPLES = (3, 5)
# Before and after a kick the square of the acceleration is at most this share of its value in the kick.
MAX_SQUARE_BESIDE_KICK = 0.1
# Fewer kicks are none: motion that decays has its largest accelerations in one or two places.
MIN_KICKS = 5
# The kernel has the width ℓ, in standard deviations of x, and the ridge that predict best.
WIDTHS, RIDGES = (0.5, 1.0, 2.0, 4.0), (1e-3, 1e-2, 1e-1, 1.0)
# The filters have these time constants, in periods 2π σ(q)/σ(q̇) of the motion, the plays these half widths, in σ(q).
FILTERS, PLAYS = (1 / 8, 1 / 2, 2.0), (0.1, 0.3, 1.0)
# The recording is cut into `BLOCKS` blocks of time, and every eighth block is predicted together.
FOLDS, BLOCKS = 8, 16
# A regression has at most this many samples: its inverse then takes about 5 ms.
MAX_PREDICTED = 400

# The reason of a law that changes with time starts with these words.
OF_TIME = "What is missed changes with time where positions, velocities and inputs are alike"


def reason_of_data(data: Trajectories) -> str:
    """The reason of a misfit that the data themselves show, with a remedy; "" if they show no reason."""
    if found := circles(data):
        return hint(found)
    if circular := [note.removeprefix("warning: ") for note in data.notes if CIRCLE in note]:
        return circular[0]
    if changes := [note.removeprefix("warning: ") for note in data.notes if LENGTH in note or COUNTS in note]:
        return changes[0][0].upper() + changes[0][1:]
    if any(MEANS in note for note in data.notes):
        return (
            f"Inputs were recorded more often than the motion: {MEANS}, and what they change within a step is lost. "
            "Try positions that are recorded as often"
        )
    if others := [x for x, role, unit in data.columns if role == "left aside" and is_of_others(unit, data.units)]:
        verb, they = ("was", "it is") if len(others) == 1 else ("were", "they are")
        return f"{', '.join(others)} {verb} left aside, and {they} of no coordinate. Try {_as_inputs(data, others)}"
    if names := filled_inputs(data):
        some, was, its = ("input", "was", "its") if len(names) == 1 else ("inputs", "were", "their")
        return (
            f"The {some} {', '.join(names)} {was} recorded more slowly than the motion and filled in, and {its} steps "
            "act at times between rows. Try the records of both before they were merged, or blank cells where nothing "
            "was recorded"
        )
    if _is_white(data):
        return (
            "Neighbouring samples tell nothing of each other: they are too far apart for the motion, or noise. Try a "
            "recording with more samples in the same time"
        )
    return ""


def _is_white(data: Trajectories) -> bool:
    """Whether the noise of every coordinate is of the size of its spread; an angle that turns has one on the circle."""
    turning = torch.tensor(data.angles, device=data.q.device)
    q = torch.cat([data.q[:, ~turning], data.q[:, turning].sin(), data.q[:, turning].cos()], 1)
    noise = precisions(Trajectories.of(data.t, q, data.lengths)).to(q)
    return bool((torch.isfinite(noise) & (noise > HALF * q.std(0))).all())


def reason_of(
    data: Trajectories,
    miss: Tensor,  # (N, n) residual at the samples, in units of q
    owner: Tensor,  # (N,) free run of each sample
    level: str = "",
) -> str | None:
    """The reason of a misfit with a remedy, in sentences; "" if the residual shows no reason, None if noise hides it.

    `level` is the level of the model, which is no remedy.
    """
    at = _Parabolas(data, owner, SAMPLES)
    if len(at.rows) < FEW:
        return ""
    lacking = at(miss, 2)
    noise = precisions(data).to(data.q) * data.balance * at.weights[2].norm() / at.h**2 / lacking.std(0)
    lacking = lacking / lacking.std(0)
    q, turning = at(data.q), torch.tensor(data.angles, device=miss.device)
    state = [q[:, ~turning], q[:, turning].sin(), q[:, turning].cos(), at(data.q, 1)]
    state += [] if data.u is None else [at(data.u)]
    x, middle = torch.cat(state, 1), at.rows[:, SAMPLES // 2]
    hidden = float(noise.square().mean())
    if kicks := _kicks(data, miss, owner):
        return kicks
    # On recordings with a missing force the rule was measured: a memory was told in 52 of 75 recordings that have one,
    # 34 times by neighbours alone, and in 8 of 50 recordings without a memory, 7 times by neighbours alone.
    by_state, by_past, by_time = (left - hidden for left in left_by_the_past(data, lacking, x, middle))
    explained = by_state > MAX_DIFFERENCE * (1 - hidden) and min(by_past, by_time) < HALF * by_state
    if not explained and not _neighbours_differ(lacking, hidden, x / x.std(0).clamp_min(1e-300), middle):
        return None if hidden > MAX_DIFFERENCE else ""
    if by_time < min(by_past, HALF * by_state):
        changes = ", or ".join(ways_of_columns(data)) or "what changes as an input (--inputs)"
        own = "Try shorter recordings, each with a fit of its own"
        return f"{OF_TIME}, as where a mass grows or leaks. {own}, or {changes}"
    return (
        "It misses differently where positions, velocities and inputs are alike: the force depends on the past, or on "
        f"what was not recorded. Try {', or '.join(_ways_to_the_past(data, level))}"
    )


def _ways_to_the_past(data: Trajectories, level: str) -> list[str]:
    """Remedies if the present state and the inputs do not give the force: only those that a fit accepts.

    Columns that were recorded and left aside come first.
    """
    ways = [] if data.u is not None or level == "full" else ["--level full, whose action remembers"]
    return [*columns, *ways] if (columns := ways_of_columns(data)) else [*ways, "a record of what else acts (--inputs)"]


def ways_of_columns(data: Trajectories) -> list[str]:
    """Remedies by angles, by columns left aside for their unit or as rates, and by properties of recordings."""
    others, rates = _left_aside(data)
    ways = _as_inputs_unless(data, others, rates)
    if angles := perhaps_angles(data):
        are = f"{angles[0]} is an angle" if len(angles) == 1 else "these are angles"
        ways.insert(0, f"--angles {shlex.quote(','.join(angles))}, where {are} in rad")
    if others and len(data) > 1:
        numbers = "is a number" if len(others) == 1 else "are numbers"
        ways.append(f"where {', '.join(others)} {numbers} of each recording, {inverse(others)}")
    return [*ways, inverse(own)] if (own := list(properties(data))) else ways


def _left_aside(data: Trajectories) -> tuple[list[str], list[str]]:
    """The columns that their unit alone has left aside, and those left aside as rates whose names say other rates."""
    aside = {
        name: role_of(name, "").role for name, role, unit in data.columns
        if role == "left aside" and role_of(name, unit).role in ("rate", "dropped")
    }  # fmt: skip
    others = [name for name, role in aside.items() if role in ("q", "input")]
    rates = [name for name, role in aside.items() if role == "rate" and is_rate_of_others(name, data.names)]
    return others, rates


def _as_inputs_unless(data: Trajectories, others: list[str], rates: list[str]) -> list[str]:
    """The flag that takes columns left aside for inputs, unless some are rates of the motion; [] for no columns."""
    if not (names := [*others, *rates]):
        return []
    unless = f", unless {', '.join(rates)} {'is a rate' if len(rates) == 1 else 'are rates'} of the motion"
    takes = f"{_as_inputs(data, names)}, which takes {', '.join(names)}, left aside so far"
    return [f"{takes}{unless if rates else ''}"]


def _as_inputs(data: Trajectories, others: list[str]) -> str:
    """The flag that takes these columns for inputs as well."""
    return f"--inputs {shlex.quote(','.join([*(x for x, role, _ in data.columns if role == 'input'), *others]))}"


class _Parabolas:
    """Parabolas through all windows of `width` samples that lie in one free run.

    `rows` (K, width) are the samples of the windows, `h` (K, 1) their mean steps. `weights` (3, width) give the value
    in the middle, the slope and the curvature, in steps.
    """

    def __init__(self, data: Trajectories, owner: Tensor, width: int):
        first = torch.arange(max(0, data.samples - width + 1), device=data.t.device)
        first = first[owner[first] == owner[first + width - 1]]
        self.rows = first[:, None] + torch.arange(width, device=data.t.device)
        self.h = data.t[self.rows].diff(dim=1).mean(1)[:, None]
        place = torch.arange(width).to(data.q) - width // 2
        self.weights = torch.linalg.pinv(torch.stack([place**0, place, place**2 / 2], -1))

    def __call__(self, x: Tensor, order: int = 0) -> Tensor:
        """The derivative of this order of x (N, m) in the middle of each window, (K, m)."""
        return (self.weights[order][:, None] * x[self.rows]).sum(1) / self.h**order


def _kicks(data: Trajectories, miss: Tensor, owner: Tensor) -> str:
    """The reason that the motion is kicked, with a remedy; "" if no kicks are seen.

    The recorded motion is looked at beside the residual: terms of a model may imitate an end stop and leave no kicks.
    """
    signals = (("What is missed comes in kicks", miss, owner), ("The recorded velocity jumps", data.q, data.trajectory))
    for what, signal, run in signals:
        if (row := _kick(data, signal, run)) is not None:
            unit = "" if data.time_unit == "1" else data.time_unit
            when = f"t = {size(float(data.t[row]), unit)} of {data.label(int(data.trajectory[row]))}"
            strikes = "".join(_as_inputs_unless(data, *_left_aside(data))) or "what strikes as an input (--inputs)"
            where = f"{what}, the hardest at {when}, as by blows and end stops"
            return f"{where}. Try {strikes}, or recordings that are cut there"
    return ""


def _kick(data: Trajectories, x: Tensor, owner: Tensor) -> int | None:
    """Row of the hardest kick, if the second derivative of x, (N, n), is kicks; else None."""
    for width in KICK_SAMPLES:
        at = _Parabolas(data, owner, width)
        square = (at(x, 2) / x.std(0)).square().sum(1)
        top = square.argsort(descending=True)[: len(square) // FEW]
        # Windows of a kick share its sample; those before and after it do not.
        around = torch.nn.functional.pad(square, (2 * width, 2 * width)).unfold(0, 4 * width + 1, 1)[top]
        beside = torch.cat([around[:, : width + 1], around[:, 3 * width :]], 1)
        alone = top[beside.amax(1) < MAX_SQUARE_BESIDE_KICK * square[top]]
        places = 1 + int((alone.sort().values.diff() > width).sum())
        most = float(square[top].sum())
        if places >= MIN_KICKS and most > HALF * float(square.sum()) and float(square[alone].sum()) > HALF * most:
            return int(at.rows[top[0], width // 2])
    return None


def _neighbours_differ(lacking: Tensor, noise: float, x: Tensor, row: Tensor) -> bool:
    """Whether accelerations (K, n) of variance 1 differ where states x (K, m) of other times are alike.

    `noise` is the share of the variance that is noise. The quarter of the samples with the nearest neighbours counts.
    A force of the state differs by its slope times the distance; a regression takes this part off the difference.
    """
    apart = torch.cdist(x, x).masked_fill((row[:, None] - row).abs() < 2 * SAMPLES, torch.inf)
    distance, other = apart.min(1)
    near = distance.argsort()[: max(1, len(x) // 4)]
    if not float(distance[near[-1]]) < MAX_DISTANCE:
        return False
    steps, differences = x[near] - x[other[near]], lacking[near] - lacking[other[near]]
    left = differences - steps @ (torch.linalg.pinv(steps) @ differences)
    freedom = max(1, len(near) - x.shape[1])
    differ = float(left.square().sum() / freedom) / (2 * lacking.shape[1])
    return differ > max(MIN_DIFFERENCE_OVER_NOISE * noise, noise + MAX_DIFFERENCE * (1 - noise))


def left_by_the_past(
    data: Trajectories,
    y: Tensor,  # (K, n) force at some samples
    x: Tensor,  # (K, m) state there
    at: Tensor,  # (K,) rows of these samples
) -> tuple[float, float, float]:
    """Mean squares of the errors of three predictions of y, over the variance of y.

    The force is predicted from the state alone, from state and past, and from state and time.
    """
    some = slice(None, None, -(-len(y) // MAX_PREDICTED))
    since = data.t - data.t[list(data.offsets)][data.trajectory]
    time = torch.stack([since, since.square()], 1)
    parts = (y[some], x[some], signals(data)[at[some]], time[at[some]])
    # Columns of mean 0 and variance 1; constant columns become 0.
    y, x, z, time = ((part - part.mean(0)) / part.std(0, correction=0).clamp_min(1e-300) for part in parts)
    apart = torch.cdist(x, x).square()
    kernels = [torch.exp(-apart / (2 * width**2)) for width in WIDTHS]
    others = (torch.ones_like(apart), *(1 + x @ x.T / x.shape[1] for x in (z, time)))
    of_state, of_past, of_time = (min(_remains(k * other, y) for k in kernels) for other in others)
    return of_state, of_past, of_time


def signals(data: Trajectories) -> Tensor:
    """The signals of the past at every sample, (N, m); each recording begins without a past."""
    speeds = slopes(data, data.q)
    spread = data.q.std(0, correction=0)
    period = 2 * math.pi * float((spread / speeds.std(0, correction=0).clamp_min(1e-300)).max())
    into = torch.cat([speeds, speeds.square(), data.q.square()], 1)
    constants = period * into.new_tensor(FILTERS)[:, None]
    widths = into.new_tensor(PLAYS)[:, None] * spread
    first, found = set(data.offsets), []
    for k in range(data.samples):
        if k in first:
            low, held = into.new_zeros(len(FILTERS), into.shape[1]), data.q[k].expand_as(widths)
        else:
            low = into[k] + (low - into[k]) * torch.exp(-(data.t[k] - data.t[k - 1]) / constants)
            held = held.clamp(data.q[k] - widths, data.q[k] + widths)
        found.append(torch.cat([low.flatten(), (data.q[k] - held).flatten()]))
    return torch.stack(found)


def _remains(kernel: Tensor, y: Tensor) -> float:
    """Mean square of the errors of predictions of left-out blocks, with the best ridge; y has variance 1."""
    blocks = torch.arange(len(y), device=y.device).tensor_split(BLOCKS)
    folds = [torch.cat(blocks[k::FOLDS]) for k in range(FOLDS)]
    found = []
    for ridge in RIDGES:
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(kernel + ridge * torch.eye(len(y)).to(kernel)))
        weights = inverse @ y
        errors = [torch.linalg.solve(inverse[fold][:, fold], weights[fold]) for fold in folds]
        found.append(float(torch.cat(errors).square().mean()))
    return min(found)
