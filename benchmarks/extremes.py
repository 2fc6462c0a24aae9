"""What each level of the ladder costs and brings on three scenes: `python benchmarks/extremes.py [--quick]`.

The table of docs/extremes.md. One thread, processor time. Writes extremes.json, by default into benchmarks/results.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import herglotz
from benchmarks import harness
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import Scene, scene
from herglotz.stepping import State, Stepper

Row = dict[str, Any]


def starts(batch: int, dof: int = 1) -> State:
    make = torch.Generator().manual_seed(1)
    q, p = torch.randn(2, batch, dof, generator=make, dtype=torch.float64).clamp(-1.2, 1.2)
    return State(q, p, torch.zeros_like(q[:, 0]))


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.process_time()
    with torch.no_grad():
        out = run()
    return time.process_time() - begin, out


SCENES: dict[str, tuple[Scene, str]] = {
    "pendulum without friction": (scene("damped_pendulum", gamma=1e-300), "conservative"),
    "damped pendulum": (scene("damped_pendulum"), "linear"),
    "quadratic drag": (scene("quadratic_drag", lam=0.05), "affine"),
}
LEVELS = ("conservative", "linear", "affine", "full")  # the last for its cost only: its s at the start is a latent
TERMS = {"conservative": "K, V", "linear": "K, V, γ", "affine": "K, V, γ, λ, drag network",
         "full": "K, V, γ, λ, units of s"}  # fmt: skip
SEEDS = 5


def terms(quick: bool) -> list[Row]:
    """Every level fitted to every scene, five seeds: error of 20 steps from unseen starts, and the cost of a step."""
    rows = []
    for name, (system, needed) in SCENES.items():
        unseen = herglotz.simulate(system, trajectories=10, steps=22, h=system.h, seed=SEEDS + 1)
        for level in LEVELS:
            if level == "full":
                full = {**rows[-1]["fit"], "level": "full"}
                rows.append({"scene": name, "needs": needed, "level": level, **costs(full)})
                continue
            found = [_fitted(system, level, unseen, seed, quick) for seed in range(1 if quick else SEEDS)]
            errors = sorted(error for _, error in found)
            row: Row = {"scene": name, "needs": needed, "level": level, "fit": found[0][0].config.to_dict()}
            row["parameters"] = sum(p.numel() for p in found[0][0].parameters())
            row |= {"median_error": statistics.median(errors), "errors": errors}
            rows.append(row | costs(found[0][0].config.to_dict()))
    return rows


def _fitted(system: Scene, level: str, unseen: Any, seed: int, quick: bool) -> tuple[ContactLagrangian, float]:
    """A model of the level, from data and weights of the seed; its error, of the motion's size (inf: a step failed)."""
    data = herglotz.simulate(system, trajectories=8 if quick else 20, steps=30, h=system.h, seed=seed)
    settings = herglotz.FitConfig(level=level, objective="residual", train_fraction=1.0, seed=seed,
                                  iterations=10 if quick else 60, correction_width=8)  # fmt: skip
    model = herglotz.fit(data, settings, progress=False).model
    q = unseen.q.reshape(10, -1, system.dof)
    start = Stepper(model).init(q[:, 0], q[:, 1], h=system.h)
    with torch.no_grad():
        out = Stepper(model).rollout(*(x.detach() for x in start), h=system.h, steps=20)
    error = (out.q - q[:, 1:22]).square().mean((-1, -2)).sqrt()
    scale = float((q - q.mean(1, keepdim=True)).square().mean().sqrt())
    return model, float(error.nan_to_num(math.inf).median()) / scale


def terms_table(rows: list[Row]) -> list[str]:
    """Scene → terms → cost of a step → error, for docs/extremes.md; bold: the level that the scene names."""
    head = ("scene", "level", "terms", "C, µs a step", "eager, µs", "error of 20 steps (range)", "error, C cost: times")
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    named = {r["scene"]: r for r in rows if r["level"] == r["needs"]}
    for r in rows:
        own = named[r["scene"]]
        level = f"**{r['level']}**" if r is own else r["level"]
        errors, error = r.get("errors"), r.get("median_error")
        shown = "not fitted" if error is None or not errors else f"{error:.2g} ({errors[0]:.2g}–{errors[-1]:.2g})"
        c_us, unit = (x["c_us"] if isinstance(x["c_us"], float) else math.nan for x in (r, own))  # text: no compiler
        times = c_us / unit
        against = f"× {times:.2g}" if error is None else f"× {error / own['median_error']:.2g}, × {times:.2g}"
        lines.append(
            f"| {r['scene']} | {level} | {TERMS[r['level']]} | {c_us:.2g} | {r['eager_us']:.0f} | {shown} | "
            f"{'' if r is own else against} |"
        )
    return lines


def costs(config: Row) -> Row:
    """µs of a step without the big-step correction, in C where it can be had and in eager; the least of five."""
    model = ContactLagrangian(ModelConfig.from_dict({**config, "correction_width": 0, "potential_width": 8}))
    x = State(*(y[0] for y in starts(1, model.dof)))
    row: Row = {}
    for name, make, steps in (("eager_us", Stepper, 50), ("c_us", herglotz.export.compile_c, 5000)):
        try:
            stepper = make(model)
        except InputError as error:
            row[name] = str(error).split(";")[0]
            continue
        best = math.inf
        for _ in range(5):
            took, out = timed(lambda s=stepper, k=steps: s.rollout(*x, h=0.1, steps=k))
            assert bool(out.ok), "a failed step is a cheap one"
            best = min(best, took)
        row[name] = 1e6 * best / steps
    return row


def main(argv: list[str] | None = None) -> None:
    arguments = harness.parser(__doc__, quick=True).parse_args(argv)
    path = harness.json_file(arguments, "extremes")
    found = {"conditions": harness.conditions(), "quick": arguments.quick, "parts": {"terms": terms(arguments.quick)}}
    harness.store(path, found)
    print("\n".join(terms_table(found["parts"]["terms"])))


if __name__ == "__main__":
    main()
