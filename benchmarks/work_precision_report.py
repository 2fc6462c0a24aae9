"""What the points say: the front of each scene, the headline, a table in words and the figure."""

from __future__ import annotations

import math
import statistics
from pathlib import Path
from typing import Any

# Families of the figure, each with what its kinds begin with; the first that fits.
FAMILIES = (
    ("learned kicks (C)", ("learned kicks",)),
    ("learned equation (C)", ("learned equation",)),
    ("learned, C", ("learned",)),
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
    for p in sorted((p for p in points if p.get(error) is not None), key=lambda p: p["us_per_time"]):
        if not kept or p[error] < kept[-1][error]:
            kept.append(p)
    return kept


NOT_TERMS = ("learned, bf16 weights",)

# What a knob is, in points: at least one of them must hold for every predicate.
COVERED = (
    ("rules of order 1, 2, 4, 6, implicit", lambda p: p.get("order") == 6 and p["kind"].startswith("lobatto")),
    ("compositions of order 4, 6, explicit", lambda p: p["kind"].startswith(("yoshida", "suzuki", "kahan"))),
    ("larger h, learned", lambda p: p["kind"] in ("learned, no re-training", "learned, distilled", "learned kicks")),
    ("correction on/off", lambda p: p["kind"] in ("learned, no correction", "learned, distilled")),
    ("width, depth", lambda p: p["kind"] in ("learned, distilled", "learned, correction 6 × 2")),
    ("level", lambda p: p["kind"].startswith("learned, level")),
    ("float32", lambda p: p["kind"] == "learned" and p.get("dtype") == "float32"),
    ("bf16 weights", lambda p: p["kind"] == "learned, bf16 weights"),
    ("Newton tolerance", lambda p: p["kind"] == "Newton tolerance"),
    ("Newton iterations", lambda p: p["kind"] == "Newton iterations"),
    ("guess order", lambda p: p["kind"] == "guess order"),
    ("eager", lambda p: p["kind"] == "learned, eager"),
    ("torch.compile", lambda p: p.get("artefact") == "torch.compile"),
    ("C", lambda p: p["kind"] == "learned" and p.get("artefact") == "C"),
    ("ONNX", lambda p: p.get("artefact") == "ONNX"),
    ("RK4, DOP853, implicit midpoint", lambda p: p["kind"].startswith("implicit midpoint")),
    ("neural ODE", lambda p: p["kind"].startswith("neural ODE")),
)
MISSING = {
    ("driven_pendulum", "compositions of order 4, 6, explicit"): "compositions take no held input",
    ("driven_pendulum", "larger h, learned"): "an input is held over h only",
    ("driven_pendulum", "level"): "an input is a force: forced only",
    ("parachute", "compositions of order 4, 6, explicit"): "not separable",
    ("double_pendulum", "compositions of order 4, 6, explicit"): "not separable",
    ("rigid_body", "compositions of order 4, 6, explicit"): "not separable",
}


TERMS = {
    "damped_oscillator": "K, V quadratic, γ, correction",
    "damped_pendulum": "K, V network, γ, correction",
    "double_pendulum": "K(q) network, V network, γ, correction",
    "parachute": "K, V, γ, λ, drag network, correction",
    "kepler": "K, V of r, γ, correction",
    "chain": "K, V of stretches, γ",
    "driven_pendulum": "K, V network, γ, friction, input, correction",
    "rigid_body": "K(q) network, V network, γ, correction",
}


def terms(scenes: dict[str, list[dict]]) -> list[str]:
    """Each scene's own model at the step of its data, and what other terms cost and bring: all fitted alike."""
    head = ("scene", "terms", "µs a step", "median error", "times the scene's own: cost, error")
    lines = ["", "## Terms", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]

    def cells(p: dict, own: dict | None) -> str:
        error = "fails" if p["median"] is None else f"{p['median']:.2g}"
        eager = " (PyTorch)" if p["artefact"] == "eager" else ""
        times = ""
        if own is not None:  # both at the step of the data
            worse = f"{p['median'] / own['median']:.2g}" if p["median"] and own["median"] else "–"
            times = f"{p['us_per_time'] / own['us_per_time']:.2g}, {worse}"
        return f"{p['us_per_time'] * p['h']:.2g}{eager} | {error} | {times} |"

    for name, points in scenes.items():
        own = next((p for p in points if p["kind"] == "learned" and p["dtype"] == "float64"), None)
        if own is not None:
            lines.append(f"| **{name}** | **{TERMS[name]}** | {cells(own, None)}")
        others = [p for p in points if p["kind"].startswith("learned, ") and p["setting"].startswith(p["kind"][9:])]
        lines += [f"| | {_changed(p['kind'][9:])} | {cells(p, own)}" for p in others if p["kind"] not in NOT_TERMS]
    return lines


def _changed(label: str) -> str:
    """What a fit with another set of terms lacks or has besides."""
    return {"level conservative": "no damping", "level linear": "one rate, no drag",
            "level affine": "drag besides, with its network"}.get(label, label)  # fmt: skip


def coverage(scenes: dict[str, list[dict]]) -> list[str]:
    """Which knob was measured on which scene, and why not where it was not."""
    lines = ["", "## Knobs", "", f"| knob | {' | '.join(scenes)} |", "|" + "---|" * (1 + len(scenes))]
    for knob, belongs in COVERED:
        cells = []
        for name, points in scenes.items():
            there = any(belongs(p) for p in points)
            cells.append("yes" if there else f"no: {MISSING.get((name, knob), 'failed or not asked for')}")
        lines.append(f"| {knob} | {' | '.join(cells)} |")
    return lines


def headline(points: list[dict], error: str = "median") -> list[dict]:
    """At the error of each learned setting on the learned front: what the others cost over what it costs.

    The front is that of the choosing starts, where there are any; the errors are those of the judging ones. `error` is
    "median" or "q95". A rival is the cheapest of its settings, of all sizes and in both precisions, whose error is no
    larger.
    """
    rows = []
    learned = [{f"choice_{error}": p[error], **p} for p in points if p["kind"].startswith("learned")]
    for p in front(learned, f"choice_{error}"):
        if p[error] is None:
            continue
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
    return "\n".join([*lines, *terms(result["scenes"]), *coverage(result["scenes"])]) + "\n"


ON_FRONT = ("learned", "learned, distilled", "learned kicks")  # shown there; all others are knobs or terms


def knob_rows(points: list[dict]) -> list[str]:
    """Settings that are off the front and stand for a knob."""
    solver = ("Newton", "guess order")
    learned = [p for p in points if p["kind"].startswith("learned") and p["kind"] not in ON_FRONT]
    chosen = [p for p in points if p["kind"].startswith(solver)] + learned
    shown = []
    for p in chosen:
        error = "fails" if p["median"] is None else f"{p['median']:.2g}"
        shown.append(f"| {p['kind']} | {p['setting']} | {p['us_per_time']:.3g} | {error} |")
    return shown


def draw(scenes: dict[str, list[dict]], path: Path) -> None:
    """A panel a scene: every setting as a faint dot, the front of every family as a line; learned ones are thick."""
    from herglotz.plots.style import SERIES, new_figure, save_figure, styled

    names = list(dict.fromkeys(family(p) for points in scenes.values() for p in points))
    order = [*(n for n, _ in FAMILIES[:3]), "learned (PyTorch, ONNX)", *(n for n, _ in FAMILIES[3:])]
    names.sort(key=order.index)
    colours = (*SERIES, "#7F7F7F", "#8C564B", "#332288", "#BCBD22")
    with styled():
        columns = min(4, len(scenes))
        rows = -(-len(scenes) // columns)
        figure = new_figure(4.4 * columns, 3.7 * rows + 0.7, "Error against cost: lower left is better")
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        for ax in axes[len(scenes) :]:
            ax.set_visible(False)
        handles: dict[str, Any] = {}
        for ax, (name, points) in zip(axes, scenes.items(), strict=False):
            for kind in names:
                k, learned = order.index(kind), kind.startswith("learned")
                mine = [p for p in points if family(p) == kind and p["median"] and math.isfinite(p["median"])]
                if not mine:
                    continue
                style = {"color": colours[k], "marker": "o*sD^vPX<>"[k], "zorder": 3 if learned else 2}
                for some, size, faint in ((mine, 3, 0.25), (front(mine), 6 if learned else 4, 1.0)):
                    x, y = [p["us_per_time"] for p in some], [max(p["median"], 1e-13) for p in some]
                    width = 0 if faint < 1 else 2.2 if learned else 1.0
                    (handles[kind],) = ax.plot(x, y, lw=width, ms=size, alpha=faint, **style)
            ax.set(xscale="log", yscale="log", title=name.replace("_", " "))
            ax.set_ylim(top=10)
            ax.set_xlabel("µs per unit of time")
            ax.set_ylabel("median error of q")
        shown = [n for n in names if n in handles]
        keys = [handles[n] for n in shown]
        figure.legend(keys, shown, loc="outside lower center", ncols=columns + 1, fontsize=8)
        save_figure(figure, path)


def spread_of(points: list[dict]) -> float:
    """The median of spread over cost: how far to trust a time."""
    return statistics.median(p["spread"] / p["us_per_time"] for p in points if p["us_per_time"] > 0)
