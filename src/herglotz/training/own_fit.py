"""Fit your own L_d: one-step errors, then whole trajectories if the data are noisy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any, cast

import torch
from torch import Tensor
from torch.func import functional_call

from herglotz.data import Trajectories
from herglotz.data.noise import roughness
from herglotz.errors import InputError, refuse
from herglotz.mechanics import DiscreteLagrangian, Partials
from herglotz.models import OwnLagrangian
from herglotz.training.baseline import Baseline, estimate_baseline
from herglotz.training.config import FitConfig
from herglotz.training.disagreeing import outlying
from herglotz.training.evaluate import evaluate
from herglotz.training.first_states import states_of_pairs
from herglotz.training.look import Look, dropped_samples, split
from herglotz.training.objectives import Fitted
from herglotz.training.one_step_fit import NOISE_OF_R, fit_one_step
from herglotz.training.problems.grid import step_inputs
from herglotz.training.problems.one_step import ResidualProblem
from herglotz.training.run import Run
from herglotz.training.stages import Stages
from herglotz.training.task import NOISY, Task
from herglotz.training.trajectory_fit import fit_states, fit_trajectories

# Settings of the fit; all others choose terms of the package's model.
TAKEN = ("objective", "optimiser", "train_fraction", "seed", "dtype", "device", "iterations", "learning_rate", "batch",
         "robust", "use_inputs", "substeps")  # fmt: skip
OBJECTIVES = ("auto", "residual", "trajectory")


def fit_own(data: Trajectories, L_d: Any, config: FitConfig, stages: Stages) -> Run:
    """Train the parameters of L_d, in place, and return the run; see `fit`.

    One-step errors J⁻¹R come first. They are the whole fit if they are as small as for exact data (`NOISY`), or if
    `config.objective` is "residual"; else multiple shooting follows. The fit uses `config.device`; the first look at
    the data and the evaluation use the CPU, where the run stays.
    """
    model, seen = _prepared(data, L_d, config)
    task = seen.task(stages)
    with stages.bar:
        _try_derivatives(model, task.data)
        fitted = _fitted(replace(task, data=task.data.to(device=config.device)), model.to(device=config.device))
        run = evaluate(task, seen, None, fitted, replace(config, objective=fitted.objective))
        found = [one.as_dict() for one in outlying(seen, fitted.model, fitted.sigma)]
    run.metrics.update(level=model.config.level, own=model.config.name, outlying=found)
    return run


def _fitted(task: Task, model: Any) -> Fitted:
    """The fitted model, an `OwnLagrangian`, and the states at the samples, on the CPU."""
    config = task.config
    problem = ResidualProblem(model, task.data, max_step=task.base.max_step, sigma=task.exact)
    refuse({
        "batch: the motion of this L_d depends on s, which needs whole trajectories; leave batch out, "
        "or train in your own loop (herglotz.losses)": config.batch and problem.carries_s,
    })  # fmt: skip
    # The discretisation errors of an arbitrary rule are far above rounding; their last digits would take hundreds of
    # iterations.
    result, rms = fit_one_step(replace(task, hurried=True), problem, "one-step error", config.iterations)
    notes = {"iterations": result.iterations, "reason": result.reason}
    sigma = max(rms / NOISE_OF_R, task.exact)
    one_step = config.objective == "residual" or (config.objective == "auto" and sigma <= NOISY * task.size)
    chosen = cast("Any", None if one_step else fit_trajectories(task, model, sigma))
    found = cast("Any", fit_states(task, model, sigma) if chosen is None else chosen.fit)
    notes["follows_data"] = found is not None and (one_step or chosen is not None)
    used = None
    if chosen is not None:
        problem = chosen.fit.problem
        problem.parameters.set(chosen.fit.theta)
        notes |= {"robust": problem.freedom is not None, "segment_steps": problem.grid.longest}
        used = problem.used.cpu()
    states = (states_of_pairs(model, task.data) if found is None else found.states()).cpu()
    return Fitted(model.cpu(), states, "residual" if one_step else "trajectory", sigma, notes, used)


def _prepared(data: Trajectories, L_d: Any, config: FitConfig) -> tuple[OwnLagrangian, Look]:
    """The module as a model, and the first look at the data, on the CPU."""
    default = FitConfig()
    other = [f.name for f in fields(config) if getattr(config, f.name) != getattr(default, f.name)]
    wrong = ", ".join(name for name in other if name not in TAKEN)
    refuse({
        f"{wrong}: model= says what the model is; leave this setting out": wrong,
        f"an L_d of your own is fitted to the objectives {', '.join(OBJECTIVES)}, not {config.objective}":
            config.objective not in OBJECTIVES,
    })  # fmt: skip
    data = data if config.use_inputs else replace(data, u=None)
    data = data.unwrapped().to(dtype=config.torch_dtype, device="cpu")
    train, unseen = split(data, config)
    dropped = dropped_samples(train, config)
    kept = train.keep(~dropped)
    base = estimate_baseline(kept, substeps=config.substeps)
    model = own_model(L_d, data, base).to(dtype=config.torch_dtype, device="cpu")
    with _differentiable(model.config.name):
        model.s_enters_motion = s_enters_motion(model, kept)
    _check_samples(model, kept)
    seen = Look(
        data, train, unseen, kept, dropped, False, data.arrival, {}, (), (),
        noise=roughness(kept), settings=config, base=base,
    )  # fmt: skip
    return model, seen


def own_model(L_d: DiscreteLagrangian, data: Trajectories, base: Baseline) -> OwnLagrangian:
    """L_d as a model of these data; InputError if it has no parameters, or frozen parameters."""
    inputs = 0 if data.u is None else data.u.shape[1]
    model = OwnLagrangian(L_d, data.dof, inputs=inputs, angles=data.angles, scale=base.scale, speed=base.speed)
    frozen = [name for name, x in model.named_parameters() if x.numel() and not x.requires_grad]
    name = model.config.name
    refuse({
        f"{name} has no parameters to train; make it a torch.nn.Module with some, or step it as it is: hz.Stepper(L_d)":
            not sum(x.numel() for x in model.parameters()),
        f"{name}: {', '.join(frozen)} do not require gradients; make them buffers (register_buffer)": frozen,
        f"{name} was made in inference mode, where nothing can be trained; make it outside":
            any(x.is_inference() for x in model.parameters()),
    })  # fmt: skip
    return model


def _check_samples(model: Any, data: Trajectories) -> None:
    """Raise InputError if L_d is not finite or random, or if L_d of a batch is not that of each sample.

    Samples are mixed where h, (...), stands beside q, (..., n).
    """
    steps, u = data.steps(), step_inputs(model, data)
    i = steps.index[torch.linspace(0, len(steps.index) - 1, 6).long()]
    h = steps.h[:1] * torch.arange(1, 7).to(data.q)
    samples = (data.q[i], data.q[i + 1], data.t[i] - data.t[0], h) + (() if u is None else (u[i],))
    name = model.config.name

    def same(*x: Tensor) -> bool:
        """Whether L_d of these samples at once, in any shape, is that of each."""
        try:
            L = model(*x[:4], 0, *x[4:]).flatten()
        except (RuntimeError, ValueError, InputError):
            return False
        return L.shape == each.shape and torch.allclose(L, each, 1e-3, 1e-3 * each.abs().max().item())

    def of_each() -> Tensor:
        """L_d of these samples, one at a time."""
        rows = [[x[k : k + 1] for x in samples] for k in range(len(i))]
        return torch.cat([model(*row[:4], 0, *row[4:]) for row in rows])

    with torch.no_grad():
        each = of_each()
        q0, q1 = data.q[steps.index], data.q[steps.index + 1]
        every = model(q0, q1, torch.zeros_like(q0[:, 0]), steps.h, 0, None if u is None else u[steps.index]).flatten()
        if len(bad := (~torch.isfinite(every)).nonzero()):
            k = int(bad[0])
            raise InputError(
                f"{name} is {float(every[k])} from q = {q0[k].tolist()} to {q1[k].tolist()}; "
                "an L_d has to be finite for the recorded positions"
            )
        refuse({
            f"{name} is random: two calls with the same arguments differ, as with dropout; switch that off by .eval()":
                not torch.equal(each, of_each()),
        })  # fmt: skip
        refuse({
            f"{name}: L_d of several samples is not that of each: q is (..., n), s0 and h are (...); "
            "write h[..., None] beside q, and .sum(-1) over coordinates; norms of a batch mix samples":
                not same(*samples),
        })  # fmt: skip
        refuse({
            f"{name} takes one leading dimension alone, and q is (..., n), s0 and h are (...), with any: layers that "
            "have a place for channels, as batch and group norms, need q.flatten(0, -2) before, and .unflatten after":
                not same(*(x.unflatten(0, (3, 2)) for x in samples)),
        })  # fmt: skip


def s_enters_motion(model: Any, data: Trajectories) -> bool:
    """True if a derivative of L_d depends on s at random parameters; at the start of a fit a coefficient may be 0."""
    make = torch.Generator().manual_seed(0)
    drawn = {
        name: torch.randn(x.shape, generator=make, dtype=torch.float64).to(x) for name, x in model.named_parameters()
    }
    steps, u = data.steps(), step_inputs(model, data)
    i = steps.index
    s = torch.randn(len(i), generator=make, dtype=torch.float64).to(data.q)
    at = lambda s: functional_call(  # noqa: E731
        model, drawn, (data.q[i], data.q[i + 1], s, steps.h, 1, None if u is None else u[i])
    )
    with torch.no_grad():
        first, second = at(s), at(-2 * s + 1)
    return not all(torch.equal(x, y) for x, y in ((getattr(first, k), getattr(second, k)) for k in ("D1", "D2", "D3")))


@contextmanager
def _differentiable(name: str) -> Iterator[None]:
    """Turn what torch.func says of an L_d that it cannot differentiate into an InputError with a remedy."""
    try:
        yield
    except (RuntimeError, NotImplementedError) as error:
        first = str(error).strip().splitlines()[0]
        raise InputError(
            f"{name}: torch.func cannot differentiate it sample by sample ({first}); write it as a pure function of "
            "tensors, without .item(), numpy, `if` on values or writing in place (batch norms do), or train it in your "
            "own loop (herglotz.losses)"
        ) from None


def _try_derivatives(model: Any, data: Trajectories) -> None:
    """Refuse an L_d that torch.func cannot differentiate sample by sample, or with a singular ∂²L_d/∂q0∂q1."""
    t = data.triples()
    rows: list[Tensor] = [x[:2] for x in (t.q0, t.q1, t.h0)]
    theta: dict[str, Tensor] = dict(model.named_parameters())
    u = step_inputs(model, data)

    def one(theta: dict[str, Tensor], q0: Tensor, q1: Tensor, h: Tensor, *u: Tensor) -> Tensor:
        P: Partials = functional_call(model, theta, (q0, q1, torch.zeros_like(h), h, 2, *u))
        return P.D12

    inputs = () if u is None else (u[t.index[:2]],)
    with _differentiable(model.config.name):
        D12 = torch.func.vmap(one, (None, *(0,) * (3 + len(inputs))))(theta, *rows, *inputs)
        torch.func.vmap(torch.func.jacrev(one), (None, *(0,) * (3 + len(inputs))))(theta, *rows, *inputs)
    if not bool((torch.linalg.det(D12) != 0).all()):
        raise InputError(
            f"{model.config.name}: ∂²L_d/∂q0∂q1 is singular at the start of the fit, so that no step follows from it; "
            "a discrete Lagrangian must join q0 to q1, as m |q1 - q0|² / 2h does"
        )
