"""The noise levels of a fit: those of the largest likelihood of the recording under the filter."""

from __future__ import annotations

import copy
import ctypes
import math
import re
from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.codegen.c_compiler import build, compiler
from herglotz.data import Trajectories
from herglotz.data.gaps import complete
from herglotz.errors import InputError
from herglotz.export.c_header import MAX_DERIVATIVES, runtime
from herglotz.export.c_wrappers import header_of
from herglotz.export.lower.c_parameters import without_parameters
from herglotz.mechanics import legendre_minus
from herglotz.models import ContactLagrangian
from herglotz.stepping.filter import Noise
from herglotz.stepping.linearise import forward_slopes
from herglotz.training.fitted_run import FittedRun
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.smoothing import SmoothingProblem
from herglotz.training.smoother import process_noise

# The scale of the noise is learned from about the last 50 samples. Windows of the measured UW double pendulum then have
# a mean surprise of 1.2 to 2.7, where 2 is right, and of 0.6 to 3.5 with a fixed scale (`benchmarks/filter.py`).
ADAPTATION = 0.02


def noise_of(run: FittedRun, theta: tuple[float, ...] = ()) -> Noise:
    """The noise of positions and of unknown forces with the largest likelihood of the fit's data under the filter.

    Both minimise −2 log p = Σ (y_i − q_i)²/S_i + log S_i over the innovations of the run's own samples whose positions
    were all read. Beyond 8 coordinates and without a C compiler both are those that the fit itself assumes.

    Source: A. C. Harvey, Forecasting, structural time series models and the Kalman filter (1989), section 3.4.

    Parameters
    ----------
    run
        What `fit` returned.
    theta
        Standard deviations of the random walks of estimated numbers, for the result.

    Returns
    -------
    Noise
        Standard deviations in the units of the data, and `adaptation`, by which the filter learns their scale.

    Raises
    ------
    InputError
        If the fit found no noise.
    """
    problem, h = _problem(run), run.h
    n = problem.n
    momentum = problem.process * problem.mass * problem.deviations * problem.speed / problem.scale / math.sqrt(h)
    if not bool((problem.deviations[:n] > 0).all()):
        raise InputError("the run's metrics have no noise (sigma) > 0; give noise to the filter")
    levels = torch.cat([problem.deviations.expand(n), momentum.expand(n)]).double()
    if n <= MAX_DERIVATIVES and _compiles():
        # The descent starts at forces so large that the filter follows any motion.
        levels[n:] = problem.mass * problem.speed / math.sqrt(h)
        levels = _descended(_likelihood(run), levels.log()).exp()
    return Noise(levels[:n].tolist(), levels[n:].tolist(), theta, ADAPTATION)


def input_at(model: ContactLagrangian, data: Trajectories, row: int, part: Tensor) -> Tensor | None:
    """The input (m,) at a part, 0 to 1, of the recorded step that starts at a row."""
    if not model.inputs:
        return None
    u = data.inputs_of_steps(torch.tensor([row]), part[None])
    # `step_inputs` has refused a recording without inputs.
    assert u is not None
    return u[0]


def momentum_at(model: ContactLagrangian, data: Trajectories, row: int) -> tuple[Tensor, Tensor]:
    """The momentum FL⁻ (n,) of a sample and the next sample, and its derivative (n, n) by the next sample."""
    q0, q1, h = data.q[row], data.q[row + 1], data.t[row + 1] - data.t[row]
    u = input_at(model, data, row, torch.tensor(0.5, dtype=torch.float64))
    zero = torch.zeros((), dtype=torch.float64)

    def momentum(q1: Tensor) -> Tensor:
        return legendre_minus(model if u is None else model.at(u), q0, q1, zero, h)[1]

    with torch.no_grad():
        return momentum(q1), forward_slopes(momentum, q1)


def parts_of(h: float, longest: float) -> int:
    """The number of equal steps in a recorded step h: the fewest that are no longer than `longest`."""
    return max(1, math.ceil(h / longest - 1e-6))


def _compiles() -> bool:
    try:
        compiler()
    except InputError:
        return False
    return True


def _likelihood(run: FittedRun) -> Callable[[Tensor], float]:
    """−2 log p of the run's data as a function of the logarithms of the levels (2n,); infinite where a step fails."""
    model = copy.deepcopy(run.model).double()
    data = complete(run.data).unwrapped().to(dtype=torch.float64, device="cpu")
    header = header_of(model, "noise", {"h": run.h, "extras": ["filter"]})
    library = build(header, re.sub(r"\bhz_", "noise_", without_parameters(runtime("innovations.c"))))
    parts, rows, places, steps = _parts(data, run.h_range[1])
    starts, slopes = [], []
    for first in data.offsets:
        p, by_q = momentum_at(model, data, first)
        starts.append(torch.cat([data.q[first], p]))
        slopes.append(by_q)
    zero = torch.zeros(1, dtype=torch.float64)
    u = data.inputs_of_steps(rows, places) if model.inputs else None
    lists = [torch.tensor(data.lengths), parts, steps, zero if u is None else u.contiguous(), data.q.contiguous()]
    lists += [torch.stack(starts), torch.stack(slopes)]

    def found(levels: Tensor) -> float:
        deviations, total = levels.exp().contiguous(), torch.zeros_like(zero)
        pointers = (ctypes.c_void_p(x.data_ptr()) for x in (*lists, deviations, total))
        failed = library.herglotz_likelihood(ctypes.c_long(len(data)), *pointers)
        return math.inf if failed or not math.isfinite(float(total)) else float(total)

    return found


def _parts(data: Trajectories, longest: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The model's steps: each recorded step is cut into the fewest equal steps that are no longer than `longest`.

    The number of model steps to each sample (N,); then of each model step the row at which its recorded step starts,
    the place of its middle in the recorded step, from 0 to 1, and its length, all (K,).
    """
    recorded = data.steps()
    counts = torch.tensor([parts_of(h, longest) for h in recorded.h.tolist()])
    parts = torch.zeros(data.samples, dtype=torch.int64).index_copy(0, recorded.index + 1, counts)
    rows, h, spread, before = (
        x.repeat_interleave(counts) for x in (recorded.index, recorded.h, counts, counts.cumsum(0) - counts)
    )
    places = (torch.arange(len(spread)).double() - before + 0.5) / spread
    return parts, rows, places, h / spread


def _descended(cost: Callable[[Tensor], float], x: Tensor) -> Tensor:
    """The minimum of a function of logarithms by coordinate descent, to a step of 0.1: a tenth of a level is enough."""
    best, step = cost(x), 1.0
    while step > 0.1:
        moved = False
        for i in reversed(range(len(x))):
            for move in (-step, step):
                while (found := cost(other := x + move * torch.eye(len(x), dtype=x.dtype)[i])) < best:
                    best, x, moved = found, other, True
        step = step if moved else step / 2
    return x


def _problem(run: FittedRun) -> SmoothingProblem:
    """The smoothing problem of the run's own data, which holds the noise that the fit assumes."""
    data, high = run.data.unwrapped(), run.h_range[1]
    process = run.metrics.get("process") or process_noise(run.model, run.h)
    sigma = run.metrics.get("sigma") or 0.0
    return SmoothingProblem(run.model, data, segment_grid(data, data.samples, high), sigma=sigma, process=process)
