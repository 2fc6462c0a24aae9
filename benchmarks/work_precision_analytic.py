"""Rules, compositions and the knobs of the solver, on the true Lagrangian, in PyTorch."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor
from work_precision_scenes import CHECKS, Setup, errors_of, exact_motion, starts_of

from herglotz.stepping import State, Status, Stepper, kahan_li, suzuki, yoshida
from herglotz.stepping.guess import EQUAL

ORDERS = {"left": 1, "right": 1, "midpoint": 2, "midpoint_heun": 2, "trapezoid_heun": 2, "strang": 2, "lobatto4": 4,
          "lobatto6": 6, "strang_exponential": 2}  # fmt: skip
COMPOSED = ((yoshida, 4), (suzuki, 4), (kahan_li, 6))
COUNT = 4  # motions; their time is shared
PATIENCE = 1.5  # seconds of a setting after which no finer step of the same rule is tried


class Counted:
    """A discrete Lagrangian that counts its evaluations."""

    def __init__(self, L_d: Any):
        self.L_d, self.count = L_d, 0
        if hasattr(L_d, "partials"):
            self.partials = self._partials
        if hasattr(L_d, "at"):
            self.at = lambda u: _Held(self, L_d.at(u))

    def __call__(self, *arguments: Tensor) -> Tensor:
        """The Lagrangian itself."""
        self.count += 1
        return self.L_d(*arguments)

    def _partials(self, *arguments: Any, **options: Any) -> Any:
        self.count += 1
        return self.L_d.partials(*arguments, **options)


class _Held:
    def __init__(self, owner: Counted, L_d: Any):
        self.owner, self.L_d = owner, L_d

    def __call__(self, *arguments: Tensor) -> Tensor:
        self.owner.count += 1
        return self.L_d(*arguments)


def analytic(setup: Setup, quick: bool) -> list[dict]:
    """Every rule and composition of a scene at several steps, and what tolerance, iterations and guess change."""
    system = setup.scene
    start = starts_of(system, COUNT, 1)
    truth = exact_motion(setup, start)
    rules = {name: system.L_d_rules[name] for name in ORDERS if name in system.L_d_rules}
    driven = setup.held is not None
    if driven:  # rules that take no input for each step are left out
        rules = {name: L_d for name, L_d in rules.items() if hasattr(L_d, "at")}
    if system.exact:
        rules["exact"] = system.L_d
    methods: list[tuple[str, str, Any, Any]] = [(r, f"{r}", L_d, Stepper) for r, L_d in rules.items()]
    if "strang" in rules and not driven:
        base = rules["strang"]
        for make, order in COMPOSED:
            methods.append((f"{make.__name__}{order}", f"{make.__name__}{order}(strang)", base, _composed(make, order)))
    found = []
    for kind, label, L_d, make in methods:
        for parts in setup.rules[-2:] if quick else setup.rules:
            one, seconds = _measured(setup, L_d, make, parts, start, truth)
            order = ORDERS.get(kind, int(kind[-1]) if kind[-1].isdigit() else None)
            found.append({"kind": kind, "setting": f"{label}, h {setup.h / parts:.4g}", "order": order, **one})
            if seconds > PATIENCE:
                break
    return found + _solver(setup, rules["midpoint_heun"], start, truth)


def _composed(make: Any, order: int) -> Any:
    return lambda L: make(L, order)


def _measured(
    setup: Setup, L_d: Any, make: Any, parts: int, start: State, truth: Tensor, roll: Any = None
) -> tuple[dict, float]:
    counted = Counted(L_d)
    steps, u = round(setup.T / setup.h) * parts, setup.inputs()
    options = {} if u is None else {"inputs": u.repeat_interleave(parts, 0)}
    with torch.no_grad():
        began = time.process_time()
        if roll is None:
            q = make(counted).rollout(*start, h=setup.h / parts, steps=steps, **options).q[:, 1:]
        else:
            q = roll(counted, start, setup.h / parts, steps, options.get("inputs"))
        seconds = time.process_time() - began
    cost = {"us_per_time": 1e6 * seconds / setup.T, "spread": 0.0, "evaluations_per_time": counted.count / setup.T}
    form = {"artefact": "eager", "dtype": "float64", "batch": COUNT, "h": setup.h / parts}
    return {**errors_of(q[:, steps // CHECKS - 1 :: steps // CHECKS], truth), **cost, **form}, seconds


def _solver(setup: Setup, L_d: Any, start: State, truth: Tensor) -> list[dict]:
    """Newton's tolerance, its iterations and the order of its guess, of the explicit midpoint rule."""
    found = []
    for tol in (1e-3, 1e-5, 1e-8):
        one, _ = _measured(setup, L_d, lambda L, t=tol: Stepper(L, tol=t), 1, start, truth)
        found.append({"kind": "Newton tolerance", "setting": f"midpoint_heun, tol {tol:g}, h {setup.h:.4g}", **one})
    for order in (0, 1, 3, 5):
        for most in (1, 2, 30) if order else (30,):

            def roll(L: Any, x: State, h: float, steps: int, u: Any, order: int = order, most: int = most) -> Tensor:
                return _guessed(Stepper(L, max_iterations=most), x, h, steps, u, order, most)

            one, _ = _measured(setup, L_d, None, 1, start, truth, roll)
            kind = "guess order" if most == 30 else "Newton iterations"
            found.append(
                {"kind": kind, "setting": f"midpoint_heun, guess of order {order}, ≤ {most} iterations", **one}
            )
    return found


def _guessed(stepper: Stepper, state: State, h: float, steps: int, u: Any, order: int, most: int) -> Tensor:
    """Steps from the polynomial of this order through the last positions; NaN once the iterations did not suffice."""
    trail, out = [state.q], []
    for k in range(steps):
        weights = EQUAL[min(order + 1, len(trail))]
        guess = torch.stack([w * q for w, q in zip(weights, trail[-len(weights) :], strict=True)]).sum(0)
        # A first step has no past to guess from: it may take as many iterations as it needs.
        now = Stepper(stepper.L_d) if k < order and most < 30 else stepper
        step = now.step(state, h, guess, None if u is None else u[k])
        state = step.state
        if bool((step.status != Status.CONVERGED).all()):
            return torch.full((len(state.q), steps, state.q.shape[-1]), torch.nan, dtype=torch.float64)
        trail = [*trail[-order:], state.q] if order else [state.q]
        out.append(state.q)
    return torch.stack(out, 1)
