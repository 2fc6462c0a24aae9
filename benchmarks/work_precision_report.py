"""What the points say: the front of each scene, the headline, a table in words and the figure."""

from __future__ import annotations

import math
import statistics
from pathlib import Path
from typing import Any

# Families of the figure, each with what its kinds begin with; the first that fits.
FAMILIES = (
    ("learned kicks (C)", ("learned kicks",)),
    (
        "learned, C",
        (
            "learned, distilled",
            "learned, Newton",
            "learned, bf16",
            "learned, level",
            "learned, no ",
            "learned, constant",
            "learned",
        ),
    ),
    ("neural ODE (C)", ("neural ODE",)),
    ("DOP853 (C)", ("DOP853",)),
    ("RK4 (C)", ("RK4",)),
    ("leapfrog (C)", ("leapfrog",)),
    ("implicit midpoint (C)", ("implicit midpoint",)),
    ("rules and compositions (PyTorch)", ("",)),
)
SLOW = ("eager", "ONNX", "torch.compile")
RIVALS = (
    ("neural ODE", lambda p: p["kind"].startswith("neural ODE")),
    ("DOP853", lambda p: p["kind"] == "DOP853, true equations"),
    ("DOP853, equal steps", lambda p: p["kind"] == "DOP853 fixed, true equations"),
    ("RK4", lambda p: p["kind"] == "RK4, true equations"),
    ("leapfrog", lambda p: p["kind"] == "leapfrog, true equations"),
)


def family(p: dict) -> str:
    """The family of a point."""
    if p["kind"].startswith("learned") and p.get("artefact") in SLOW:
        return "learned (PyTorch, ONNX)"
    return next(name for name, starts in FAMILIES if p["kind"].startswith(starts))


def front(points: list[dict], error: str = "median") -> list[dict]:
    """Points that no other beats in both error and cost, cheapest first."""
    kept: list[dict] = []
    for p in sorted((p for p in points if p[error] is not None), key=lambda p: p["us_per_time"]):
        if not kept or p[error] < kept[-1][error]:
            kept.append(p)
    return kept


def headline(points: list[dict], error: str = "median") -> list[dict]:
    """At the error of each learned setting on the learned front: what the others cost over what it costs.

    `error` is "median" (of all starts) or "q95". A rival is the cheapest of its settings, of all sizes and in both
    precisions, whose error is no larger.
    """
    rows = []
    for p in front([p for p in points if p["kind"].startswith("learned")], error):
        row: dict[str, Any] = {k: p[k] for k in ("setting", "us_per_time", "spread")}
        row |= {"kind": p["kind"], "error": p[error]}
        for name, belongs in RIVALS:
            good = [q for q in points if belongs(q) and q[error] is not None and q[error] <= p[error]]
            best = min(good, key=lambda q: q["us_per_time"], default=None)
            row[name] = None if best is None else best["us_per_time"] / p["us_per_time"]
            row[f"{name}: setting"] = None if best is None else best["setting"]
        rows.append(row)
    return rows


def add_leapfrog_unit(result: dict[str, Any]) -> None:
    """Every cost also in steps of C leapfrog on the damped pendulum (or, without it, another scene) of the same run."""
    order = ("damped_pendulum", *result["scenes"])
    name = next((n for n in order if any(map(_leapfrog, result["scenes"].get(n, [])))), None)
    if name is None:
        return
    steps = [p["us_per_time"] / p["evaluations_per_time"] for p in result["scenes"][name] if _leapfrog(p)]
    result["leapfrog_step_us"], result["leapfrog_of"] = min(steps), name
    for points in result["scenes"].values():
        for p in points:
            p["leapfrogs_per_time"] = p["us_per_time"] / result["leapfrog_step_us"]


def _leapfrog(p: dict) -> bool:
    return p["kind"].startswith("leapfrog")


def markdown(result: dict[str, Any]) -> str:
    """The fronts and the headline as tables."""
    unit = result.get("leapfrog_step_us")
    lines = ["# Error against cost", "", f"Commit {result['commit']}, {result['machine']['cores']} cores, one thread."]
    lines += [
        "Errors: the largest departure of a position from the truth at four times up to T, median of unseen starts."
    ]
    if unit:
        lines += [f"One C leapfrog step of the {result['leapfrog_of'].replace('_', ' ')}: {1e3 * unit:.3g} ns."]
    for name, points in result["scenes"].items():
        lines += [
            "",
            f"## {name}",
            "",
            "| setting | µs per time | ± | leapfrog steps | evaluations | flops | median | 95 % |",
        ]
        lines += ["|---|---|---|---|---|---|---|---|"]
        for p in front(points):
            cells = [p.get("leapfrogs_per_time"), p.get("evaluations_per_time"), p.get("flops_per_time")]
            lines.append(
                f"| {p['kind'].split(',')[0]}: {p['setting']} | {p['us_per_time']:.3g} | {p['spread']:.2g} | "
                + " | ".join("" if c is None else f"{c:.3g}" for c in cells)
                + f" | {p['median']:.2g} | {'' if p['q95'] is None else format(p['q95'], '.2g')} |"
            )
        knobs = knob_rows(points)
        if knobs:
            lines += ["", "| knob | setting | µs per time | median |", "|---|---|---|---|", *knobs]
        for error in ("median", "q95"):
            rows = result["headline"].get(name, {}).get(error, [])
            if rows:
                lines += ["", f"Cost of the others over that of a learned stepper, at its {error} error:", ""]
                lines += [
                    f"| learned | error | µs per time | {' | '.join(n for n, _ in RIVALS)} |",
                    "|" + "---|" * (3 + len(RIVALS)),
                ]
            for r in rows:
                ratios = " | ".join("not reached" if r[n] is None else f"{r[n]:.3g}" for n, _ in RIVALS)
                lines.append(f"| {r['setting']} | {r['error']:.2g} | {r['us_per_time']:.3g} | {ratios} |")
    return "\n".join(lines) + "\n"


KNOBS = ("Newton tolerance", "Newton iterations", "guess order", "learned, eager", "learned, Newton tolerance",
         "learned, bf16 weights", "learned, ONNX", "learned, torch.compile", "learned, no re-training")  # fmt: skip
TERMS = ("learned, level", "learned, no correction", "learned, no input", "learned, constant mass")


def knob_rows(points: list[dict]) -> list[str]:
    """Settings that are off the front and stand for a knob."""
    chosen = [p for p in points if p["kind"] in KNOBS or p["kind"].startswith(TERMS)]
    shown = []
    for p in chosen:
        error = "fails" if p["median"] is None else f"{p['median']:.2g}"
        shown.append(f"| {p['kind']} | {p['setting']} | {p['us_per_time']:.3g} | {error} |")
    return shown


def draw(scenes: dict[str, list[dict]], path: Path) -> None:
    """A panel a scene: every family's own points, and the front of them all as a line."""
    from herglotz.plots.style import INK, SERIES, new_figure, save_figure, styled

    names = list(dict.fromkeys(family(p) for points in scenes.values() for p in points))
    order = [*(n for n, _ in FAMILIES[:2]), "learned (PyTorch, ONNX)", *(n for n, _ in FAMILIES[2:])]
    names.sort(key=order.index)
    with styled():
        columns = min(4, len(scenes))
        rows = -(-len(scenes) // columns)
        figure = new_figure(4.4 * columns, 3.7 * rows + 0.7, "Error against cost")
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        for ax in axes[len(scenes) :]:
            ax.set_visible(False)
        handles: dict[str, Any] = {}
        for ax, (name, points) in zip(axes, scenes.items(), strict=False):
            for k, kind in enumerate(names):
                mine = [p for p in points if family(p) == kind and p["median"] and math.isfinite(p["median"])]
                if not mine:
                    continue
                style = {"color": SERIES[k % len(SERIES)], "marker": "o*sD^vPX<>"[k % 10], "ms": 6 if k < 2 else 3.5}
                x, y = [p["us_per_time"] for p in mine], [max(p["median"], 1e-15) for p in mine]
                (handles[kind],) = ax.plot(x, y, lw=0, alpha=0.75, zorder=3 if k < 2 else 2, **style)
            best = front(points)
            ax.step(
                [p["us_per_time"] for p in best],
                [max(p["median"], 1e-15) for p in best],
                where="post",
                color=INK,
                lw=1.2,
            )
            ax.set(xscale="log", yscale="log", title=name.replace("_", " "))
            ax.set_xlabel("µs per unit of time")
            ax.set_ylabel("median error of q")
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns + 1, fontsize=8)
        save_figure(figure, path)


def spread_of(points: list[dict]) -> float:
    """The median of spread over cost: how far to trust a time."""
    return statistics.median(p["spread"] / p["us_per_time"] for p in points if p["us_per_time"] > 0)
