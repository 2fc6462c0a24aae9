"""Where each setting breaks, measured: `python benchmarks/extremes.py [--quick] [--only PART …] [--out FOLDER]`.

The sweeps behind docs/extremes.md: h, γ, magnitude, precision, length (1e8 steps in C), size, and what each scene's
terms cost. One thread, processor time. Writes extremes.json and extremes.png, by
default into benchmarks/results.
"""

from __future__ import annotations

import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import herglotz
from benchmarks import harness
from herglotz.errors import InputError
from herglotz.export import export_c
from herglotz.export.c_wrapper import FLAGS, compiler
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.plots.style import new_figure
from herglotz.scenes import Scene, scene
from herglotz.stepping import Rollout, State, Stepper

Row = dict[str, Any]
DOUBLE = torch.float64
FORMS: dict[str, dict[str, Any]] = {"explicit": {}, "Newton": {"correction_width": 8}}


def build(noise: float = 0.0, dtype: torch.dtype = DOUBLE, /, **settings: Any) -> ContactLagrangian:
    model = ContactLagrangian(ModelConfig(**settings))
    make = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += noise * torch.randn(parameter.shape, generator=make, dtype=DOUBLE)
    return model.to(dtype)


def starts(batch: int, dof: int = 1, dtype: torch.dtype = DOUBLE) -> State:
    make = torch.Generator().manual_seed(1)
    q, p = torch.randn(2, batch, dof, generator=make, dtype=DOUBLE).clamp(-1.2, 1.2).to(dtype)
    return State(q, p, torch.zeros_like(q[:, 0]))


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.process_time()
    with torch.no_grad():
        out = run()
    return time.process_time() - begin, out


def cast(x: State, dtype: torch.dtype) -> State:
    return State(*(y.to(dtype) for y in x))


def outcome(out: Rollout) -> dict[str, int]:
    """How many samples ended how."""
    worst = out.status.amax(-1)
    return {"samples": worst.numel(), "converged": int(out.ok.sum()), "silent": silent(out)}


def silent(out: Rollout) -> int:
    """States that are not finite under a status that says they are: 0, or the library is wrong."""
    x = torch.cat([out.q, out.p, out.s[..., None], out.sigma[..., None]], -1)[..., 1:, :]
    return int((~torch.isfinite(x).all(-1) & (out.status == 0)).sum())


def step_size(_quick: bool) -> list[Row]:
    """Error of p after 10 steps, exact L_d of the oscillator; and of float32 models against their float64 twins."""
    oscillator, rows = scene("damped_oscillator"), []

    def add(what: str, L_d: Any, x: State, h: float, exact: Tensor, good: Tensor | bool = True) -> None:
        out = timed(lambda: Stepper(L_d).rollout(*x, h=h, steps=10))[1]
        errors = (out.final.p.double() - exact)[out.ok & good].abs()
        rows.append({"what": what, "h": h, "error_p": float(errors.max()) if len(errors) else math.nan, **outcome(out)})

    for h in (10.0**k for k in range(-8, 3)):
        for dtype in (torch.float32, DOUBLE):
            x, h_used = starts(20, dtype=dtype), float(torch.tensor(h, dtype=dtype))
            add(f"exact L_d, {str(dtype)[6:]}", oscillator.L_d, x, h, oscillator.flow(*cast(x, DOUBLE), 10 * h_used)[1])
        x, h_used = starts(20, dtype=torch.float32), float(torch.tensor(h, dtype=torch.float32))
        for name, settings in FORMS.items():
            single, twin = build(0.1, torch.float32, **settings), build(0.1, **settings).float().double()
            with torch.no_grad():
                exact = Stepper(twin).rollout(*cast(x, DOUBLE), h=h_used, steps=10)
            forms: dict[str, Any] = {"increments": single} | ({"by position": ByPosition(single)} if settings else {})
            for form, L_d in forms.items():
                add(f"{name}, float32, {form}", L_d, x, h, exact.final.p, exact.ok)
    return rows


class ByPosition:
    """A model that offers no increments: the naive form."""

    def __init__(self, model: ContactLagrangian):
        self.model = model

    def __call__(self, q0, q1, s0, h):
        """L_d."""
        return self.model(q0, q1, s0, h)

    def partials(self, q0, q1, s0, h, order=1):
        """Its derivatives."""
        return self.model.partials(q0, q1, s0, h, order)


def damping(_quick: bool) -> list[Row]:
    """The exact oscillator over γ at γh ≤ 1, and the largest γh that each level steps."""
    rows, x = [], starts(5)
    for gamma in (-1.0, 0.0, 1e-12, 1e-6, 1e-3, 1.0, 2.0, 1e3, 1e6):
        oscillator, h = scene("damped_oscillator", gamma=gamma), min(0.1, 1 / max(gamma, 1e-9))
        _, out = timed(lambda o=oscillator, h=h: Stepper(o.L_d).rollout(*x, h=h, steps=10))
        error = float((out.final.q - oscillator.flow(*x, 10 * h)[0]).abs().max())
        sigma = float((out.sigma[:, -1] / math.exp(-gamma * 10 * h) - 1).abs().max())
        row: Row = {"what": "exact L_d", "gamma": gamma, "h": h, "error_q": error, "error_sigma": sigma}
        rows.append(row | outcome(out))
    for level in ("linear", "affine", "full", "forced"):
        for h in (1e-3, 1.0):
            low, high = 1.0, 100.0
            for _ in range(12):
                middle = (low + high) / 2
                model = build(level=level, rate=middle / h, potential_width=0)
                good = bool(timed(lambda m=model, h=h: Stepper(m).step(x, h))[1].status.eq(0).all())
                low, high = (middle, high) if good else (low, middle)
            rows.append({"what": f"largest γh, {level}", "h": h, "gamma_h": low})
    return rows


def magnitude(_quick: bool) -> list[Row]:
    """A linear motion of size x against x times the motion of size 1; and angles after many turns."""
    oscillator, rows = scene("damped_oscillator"), []
    one = State(torch.ones(1, 1, dtype=DOUBLE), torch.full((1, 1), 0.5, dtype=DOUBLE), torch.zeros(1, dtype=DOUBLE))
    for exponent in (-320, -300, -200, -100, 0, 100, 150, 153, 154, 155, 200, 300):
        size = float(f"1e{exponent}")
        _, out = timed(lambda z=size: Stepper(oscillator.L_d).rollout(one.q * z, one.p * z, one.s, h=0.1, steps=10))
        exact = oscillator.flow(one.q * size, one.p * size, one.s, 1.0)[0]
        error = float(((out.final.q - exact) / size).abs())
        rows.append({"what": "size of q", "size": size, "error_q": error, **outcome(out)})
    model = build(level="conservative", potential_width=0)
    for turns in (0, 1, 1e3, 1e6, 1e9):
        for explicit in (True, False):
            stepper = Stepper(model, explicit=explicit)
            away = 2 * math.pi * turns
            _, near = timed(lambda s=stepper: s.rollout(*one, h=0.1, steps=100))
            _, far = timed(lambda s=stepper, a=away: s.rollout(one.q + a, one.p, one.s, h=0.1, steps=100))
            what = f"turns, {'explicit' if explicit else 'Newton'}"
            rows.append({"what": what, "turns": turns, "error_p": float((far.p - near.p).abs().max()), **outcome(far)})
    return rows


def precision(quick: bool) -> list[Row]:
    """Median relative error of q against the float64 run after so many steps of 0.125."""
    rows, steps = [], 256 if quick else 2048
    for name, settings in FORMS.items():
        settings = {"rate": 0.01, **settings}
        reference, x = build(0.1, **settings), starts(20)
        exact = timed(lambda r=reference, x=x: Stepper(r).rollout(*x, h=0.125, steps=steps))[1]
        single = build(0.1, torch.float32, **settings)
        coarse = build(0.1, **settings).to(torch.bfloat16)
        forms = {"float32": single, "bf16 weights, float64": coarse.double(),
                 "bf16 weights, float32": build(0.1, **settings).to(torch.bfloat16).float()}  # fmt: skip
        for form, model in forms.items():
            dtype = next(model.parameters()).dtype
            start = cast(x, dtype)
            out = timed(lambda m=model, y=start: Stepper(m).rollout(*y, h=0.125, steps=steps))[1]
            error = ((out.q.double() - exact.q).abs() / (1 + exact.q.abs())).amax(-1)
            at = [2**k for k in range(int(math.log2(steps)) + 1)]
            growth = {str(k): float(error[:, : k + 1].amax(-1).median()) for k in at}
            rows.append({"what": f"{name}, {form}", "error_q_by_steps": growth, **outcome(out)})
    return rows


PROGRAM = """
#include <stdio.h>
#include <time.h>
#include "run.h"
int main(void) {
  run_state x = {{1.2}, {0.4}, 0, 1};
  run_track track;
  run_real left;
  long k;
  int part, status = 0;
  run_track_start(&x, &track);
  for (part = 0; part < 10; part++) {
    clock_t begin = clock();
    for (k = 0; k < %d && !status; k++) status = run_advance(&x, &track, (run_real)0.1, &left);
    printf("%%d %%.17g %%.17g %%.17g %%.17g %%g\\n", status, (double)x.q[0], (double)x.p[0], (double)x.s,
        (double)x.sigma, (double)(clock() - begin) / CLOCKS_PER_SEC);
  }
  return 0;
}
"""


def length(quick: bool) -> list[Row]:
    """1e8 steps of h = 0.1 in C, in ten parts: σ against e^{−γt}, energy, and the time of every part."""
    part, rows = (10**5 if quick else 10**7), []
    cases = {
        "conservative": {"level": "conservative", "potential_width": 0},
        "γ = 1e-6": {"rate": 1e-6, "potential_width": 0},
        "γ = 1e-6, Newton": {"rate": 1e-6, "potential_width": 0, "correction_width": 2},
        "to rest, γ = 0.1": {"rate": 0.1, "potential_width": 0},
        "to rest, γ = 0.1, Newton": {"rate": 0.1, "potential_width": 0, "correction_width": 2},
    }
    for name, settings in cases.items():
        with tempfile.TemporaryDirectory() as folder:
            export_c(build(**settings), Path(folder, "run.h"), h=0.1, name="run")
            Path(folder, "run.c").write_text(PROGRAM % part)
            program = str(Path(folder, "run"))
            subprocess.run([*compiler(), *FLAGS, str(Path(folder, "run.c")), "-o", program, "-lm"], check=True)
            text = subprocess.run([program], capture_output=True, text=True, check=True).stdout
        parts = [[float(y) for y in line.split()] for line in text.splitlines()]
        rate = 0.0 if name == "conservative" else settings["rate"]
        drift = [
            abs(x[4] / math.exp(-rate * 0.1 * part * (k + 1)) - 1) if rate * 0.1 * part * (k + 1) < 600 else x[4]
            for k, x in enumerate(parts)
        ]
        seconds = [x[5] for x in parts]
        row: Row = {"what": name, "steps": 10 * part, "status": int(parts[-1][0]), "sigma_drift": max(drift)}
        row |= {"ns_per_step": 1e9 * sum(seconds) / (10 * part), "slowest_over_first": max(seconds) / seconds[0]}
        row |= {"q_end": parts[-1][1], "s_end": parts[-1][3]}
        if name == "conservative":
            start = 0.5 * 0.4**2 + 1 - math.cos(1.2)
            row["energy_error"] = max(abs(0.5 * x[2] ** 2 + 1 - math.cos(x[1]) - start) for x in parts)
        rows.append(row)
    return rows


def size(quick: bool) -> list[Row]:
    """Milliseconds a step and the memory of the process, over n and B."""
    rows = []
    for n in (1, 8) if quick else (1, 4, 16, 64, 128, 256):
        for name, settings in FORMS.items():
            ones = (1.0,) * n
            model = build(0.02 / n**0.5, angles=(True,) * n, scale=ones, speed=ones, stiffness=ones, tilt=(0.0,) * n,
                          potential_width=4, **settings)  # fmt: skip
            took, out = timed(lambda m=model, n=n: Stepper(m).rollout(*starts(2, n), h=0.1, steps=3))
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            row: Row = {"what": f"n, {name}", "n": n, "B": 2, "ms_per_step": 1e3 * took / 3, "peak_mb": peak}
            rows.append(row | outcome(out))
    for batch in (1, 1000) if quick else (1, 10, 100, 1000, 10_000, 100_000, 1_000_000):
        took, out = timed(lambda b=batch: Stepper(build(0.1, potential_width=4)).rollout(*starts(b), h=0.1, steps=3))
        rows.append({"what": "B, explicit", "n": 1, "B": batch, "ms_per_step": 1e3 * took / 3, **outcome(out)})
    return rows


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


def plot(found: dict[str, list[Row]], path: Path) -> None:
    figure = new_figure(13, 4.2, "Where each setting breaks")
    axes = figure.subplots(1, 3)
    for what in dict.fromkeys(r["what"] for r in found.get("step_size", [])):
        mine = [r for r in found["step_size"] if r["what"] == what]
        axes[0].loglog([r["h"] for r in mine], [r["error_p"] for r in mine], "o-", ms=3, label=what)
    axes[0].set(xlabel="h", ylabel="error of p after 10 steps", title="Step size")
    for r in found.get("precision", []):
        growth = r["error_q_by_steps"]
        axes[1].loglog([int(k) for k in growth], list(growth.values()), "o-", ms=3, label=r["what"])
    axes[1].set(xlabel="steps", ylabel="median error of q against float64", title="Precision")
    for what in dict.fromkeys(r["what"] for r in found.get("magnitude", []) if "turns" in r):
        mine = [r for r in found["magnitude"] if r["what"] == what and r["turns"] > 0]
        axes[2].loglog([r["turns"] for r in mine], [r["error_p"] for r in mine], "o-", ms=3, label=what)
    axes[2].set(xlabel="turns of the angle", ylabel="error of p after 100 steps", title="Many turns, float64")
    for ax in axes:
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=7)
    harness.picture(figure, path)


PARTS = (step_size, damping, magnitude, precision, length, size, terms)


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__, quick=True)
    parser.add_argument("--only", nargs="*", choices=[p.__name__ for p in PARTS], help="parts to run")
    arguments = parser.parse_args(argv)
    path = harness.json_file(arguments, "extremes")
    found = harness.load(path, {"parts": {}})["parts"]  # parts that are not run are kept
    for part in (bar := tqdm([p for p in PARTS if not arguments.only or p.__name__ in arguments.only])):
        bar.set_description(part.__name__)
        begin = time.perf_counter()
        found[part.__name__] = part(arguments.quick)
        for row in found[part.__name__]:
            tqdm.write(str({k: f"{v:.3g}" if isinstance(v, float) else v for k, v in row.items() if k != "fit"}))
        tqdm.write(f"{part.__name__}: {time.perf_counter() - begin:.1f} s")
        parts = {p.__name__: found.get(p.__name__, []) for p in PARTS}
        harness.store(path, {"conditions": harness.conditions(), "quick": arguments.quick, "parts": parts})
        plot(parts, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
