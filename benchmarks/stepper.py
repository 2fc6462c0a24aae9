"""Speed and agreement of every form of a stepper: `python benchmarks/stepper.py [--quick] [--out FOLDER]`.

One thread, processor time (the rollout of 1e6 steps: time on the wall). What is compared is timed in turn within each
repeat, so that a busy machine slows both; a ratio is one of a single repeat, and the table gives their median and
range. Writes stepper.json and stepper.md.
"""

from __future__ import annotations

import math
import os
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import herglotz
from benchmarks import harness
from benchmarks.harness import seconds
from benchmarks.reference_steppers import Hand, jax_rollout
from herglotz import export
from herglotz.codegen.c_compiler import FLAGS
from herglotz.errors import InputError
from herglotz.export import compile_c
from herglotz.export.load import CLibrary
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper

H = 0.1  # 63 steps in a period of the models, whose stiffness is 1
Row = dict[str, Any]


def model_of(n: int, width: int = 16, level: str = "linear", dtype: torch.dtype = torch.float64) -> ContactLagrangian:
    """Coupled damped pendulums with random networks, so that no step is trivial."""
    one: tuple[float, ...] = (1.0,) * n
    more: dict[str, Any] = {}
    if level == "mass":
        level, more = "linear", {"mass_width": 8}
    if level == "forced":
        more = {"coulomb": True}
    config = ModelConfig(
        (True,) * n, level, one, one, one, (0.0,) * n, 0.05, correction_width=width, correction_depth=2, **more
    )
    model = ContactLagrangian(config)
    make = torch.Generator().manual_seed(1)
    scale = 0.05 / max(1.0, (width / 16) ** 0.5) / n**0.5
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += scale * torch.randn(parameter.shape, generator=make, dtype=torch.float64)
        if model.friction is not None:
            model.friction.viscous.abs_()
    return model.to(dtype)


def start(n: int, batch: int, dtype: torch.dtype) -> State:
    make = torch.Generator().manual_seed(2)
    x = torch.rand(batch, 2 * n, generator=make, dtype=torch.float64).sub(0.5).to(dtype)
    return State(x[:, :n].contiguous(), x[:, n:].contiguous(), torch.zeros(batch, dtype=dtype))


def alternate(ours: Callable[[], Any], other: Callable[[], Any], repeats: int, work: tuple[int, int]) -> Row:
    """µs a step and sample of both, and other / ours; `work` counts the steps · samples of each."""
    pairs = [(seconds(ours) / work[0], seconds(other) / work[1]) for _ in range(repeats + 1)][1:]  # the first warms up
    ratios = [b / a for a, b in pairs]
    return {
        "ours_us": 1e6 * statistics.median(a for a, _ in pairs),
        "other_us": 1e6 * statistics.median(b for _, b in pairs),
        "ratio": {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios)},
    }


def rolls(stepper: Any, state: State, steps: int) -> Callable[[], Any]:
    """A rollout to be timed."""
    return torch.no_grad()(lambda: stepper.rollout(*state, h=H, steps=steps))


def row(what: str, most: float | None = None, *, least: float | None = None, unit: str = "", **found: Any) -> Row:
    """A row of the table: what was measured, its target, and whether the target was met."""
    value = found["ratio"]["median"] if "ratio" in found else found.get("value")
    target = f"<= {most:g}" if most is not None else f">= {least:g}" if least is not None else ""
    met = None if value is None or not target else (least or -math.inf) <= value <= (most or math.inf)
    return {"what": what, "target": f"{target} {unit}".strip() if target else "", "met": met, "unit": unit, **found}


def against_hand(quick: bool) -> list[Row]:
    """C against `hand_written.c` of the same network."""
    rows = []
    for n in (1, 2, 8):
        for width, dtype in ((16, torch.float64), (64, torch.float32)):
            model = model_of(n, width, dtype=dtype)
            hand, ours, one = Hand(model), compile_c(model, h=H), State(*(x[0] for x in start(n, 1, dtype)))
            steps = (2000 if quick else 20000) // (1 if width < 64 else 8) // (1 if n < 8 else 4)
            close = float((hand.rollout(*one, h=H, steps=50) - ours.rollout(*one, h=H, steps=50).q[1:]).abs().max())
            assert close < (1e-9 if dtype == torch.float64 else 1e-4), close
            timed = alternate(rolls(hand, one, steps), rolls(ours, one, steps), 3 if quick else 9, (steps, steps))
            timed |= {"ours_us": timed["other_us"], "other_us": timed["ours_us"]}
            rows.append(row(f"C / hand-written C, n={n}, {width}x2, {_short(dtype)}, B=1", 1.3, **timed))
    return rows


def against_jax(quick: bool) -> list[Row]:
    """A jitted scan of JAX against C."""
    rows = []
    for batch, width, dtype in ((1, 16, torch.float64), (1, 64, torch.float32), (4096, 16, torch.float64),
                                (4096, 64, torch.float32)):  # fmt: skip
        model, least = model_of(2, width, dtype=dtype), 4.0 if batch == 1 else 1.1
        what = f"JAX scan / C, n=2, {width}x2, {_short(dtype)}, B={batch}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            jax = jax_rollout(model)
        if jax is None:
            rows.append(row(what, least=least, note="jax is not installed"))
            continue
        ours, state = compile_c(model, h=H), start(2, batch, dtype)
        steps = (2000 if quick else 10000) if batch == 1 else (10 if quick else 50)
        last = torch.as_tensor(np.array(jax(*state, H, steps)[-1]))
        close = float((last - ours.rollout(*state, h=H, steps=steps).q[:, -1]).abs().max())
        scan = lambda s=state, j=jax, k=steps: j(*s, H, k)  # noqa: E731
        timed = alternate(rolls(ours, state, steps), scan, 3 if quick else 7, (steps * batch, steps * batch))
        rows.append(row(what, least=least, difference=close, **timed))
    return rows


def long_rollout(quick: bool) -> list[Row]:
    """The wall's clock of 1e6 steps."""
    rows, steps = [], 100_000 if quick else 1_000_000
    for width in (0, 16):
        stepper, one = herglotz.compile(model_of(2, width)), State(*(x[0] for x in start(2, 1, torch.float64)))
        took = statistics.median(seconds(rolls(stepper, one, steps), time.perf_counter) for _ in range(3))
        what = f"hz.compile, 1e6 steps, n=2, float64, {f'{width}x2 correction' if width else 'no correction'}"
        rows.append(row(what, 8, unit="s", value=took * 1_000_000 / steps, steps_timed=steps))
    return rows


FORMATS = {"ONNX": ("export_onnx", "load_onnx", "onnx"), "AOTInductor": ("export_aoti", "load_pt2", "pt2")}


def loaded(model: ContactLagrangian, name: str) -> Any:
    """The model written in a format and read again; a text that says why where it cannot be had."""
    write, read, kind = FORMATS[name]
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"model.{kind}")
            getattr(export, write)(model, path, h=H)
            return getattr(export, read)(path)
    except (AttributeError, InputError, ImportError, RuntimeError) as error:
        return f"not available: {str(error).splitlines()[0][:100]}"


def against_c(
    name: str, model: ContactLagrangian, form: Any, what: str, steps: dict[int, int], repeats: int
) -> list[Row]:
    """Rollouts of another form against C, for each batch size of `steps`; C takes 20 times as many steps at B = 1."""
    ours, rows = compile_c(model, h=H), []
    for batch, few in steps.items():
        label, most = f"{name} rollout / C, {what}, B={batch}", 50.0 if batch == 1 else 2.5
        if isinstance(form, str):
            rows.append(row(label, note=form))
            continue
        state, many = start(2, batch, next(model.parameters()).dtype), few * (20 if batch == 1 else 1)
        timed = alternate(rolls(ours, state, many), rolls(form, state, few), repeats, (many * batch, few * batch))
        rows.append(row(label, most, **timed))
    return rows


def other_formats(quick: bool) -> list[Row]:
    """ONNX and AOTInductor rollouts against our C: a small network, one whose products dominate, and no correction.

    The first six steps of a rollout have no history to guess from: long rollouts are timed, and a lone step apart.
    """
    rows, few, repeats = [], {1: 16, 1024: 8} if quick else {1: 1000, 1024: 80}, 3 if quick else 5
    for width, dtype in ((16, torch.float64), (64, torch.float32), (0, torch.float64)):
        model = model_of(2, width, dtype=dtype)
        size = f"n=2, {f'{width}x2' if width else 'explicit'}, {_short(dtype)}"
        for name in ("ONNX",) if quick else FORMATS:  # AOTInductor compiles for a minute each
            form = loaded(model, name)
            rows += against_c(name, model, form, size, few, repeats)
            if isinstance(form, str):
                continue
            alone, lone = 20 if quick else 200, rolls(form, start(2, 1, dtype), 1)
            took = seconds(lambda k=alone, one=lone: [one() for _ in range(k)])
            rows.append(row(f"{name}, a rollout of one step, {size}, B=1", unit="µs", value=1e6 * took / alone))
            if dtype == torch.float64:
                rows.append(against_eager(name, model, form, 100 if quick else 1000))
    return rows


def other_levels(quick: bool) -> list[Row]:
    """The levels whose steps cost more, as ONNX against C: what couples all samples' Jacobians, forces, flows of s."""
    rows, few = [], {1: 8, 1024: 4} if quick else {1: 200, 1024: 20}
    for level in ("affine", "forced", "full", "mass"):
        model = model_of(2, 16, level)
        what = f"n=2, {level}, 16x2, float64"
        rows += against_c("ONNX", model, loaded(model, "ONNX"), what, few, 3 if quick else 5)
    return rows


def against_eager(name: str, model: ContactLagrangian, form: Any, steps: int) -> Row:
    """The states of a form of the model against those of the eager stepper."""
    state = start(2, 2, torch.float64)
    with torch.no_grad():
        ours, eager = (o.rollout(*state, h=H, steps=steps) for o in (form, Stepper(model, tol=4e-16)))
    worst = max(_relative(getattr(ours, x), getattr(eager, x)) for x in "qps")
    return row(f"{name} against eager over {steps} steps, float64", 1e-12, value=worst)


def derivatives(quick: bool) -> list[Row]:
    """A step with its Jacobian in C against a step of a rollout over the same motion, both sample by sample."""
    rows, steps, times = [], 100, 20 if quick else 200
    for width in (0, 16):
        ours, one = compile_c(model_of(2, width), h=H), start(2, 1, torch.float64)
        assert isinstance(ours.loop, CLibrary)
        roll, (q, p, s, *_) = ours.loop.prepared(*one, torch.full((1, steps), H, dtype=torch.float64))
        roll()
        states = State(*(x[0, 1:].repeat(times, *(1,) * (x.ndim - 2)) for x in (q, p, s)))
        again = lambda roll=roll: [roll() for _ in range(times)]  # noqa: E731
        timed = alternate(again, lambda o=ours, x=states: o.linearise(x, H), 9, (steps * times, steps * times))
        what = f"{width}x2" if width else "explicit"
        rows.append(row(f"C, step with Jacobian / step of a rollout, n=2, {what}, float64", 3, **timed))
    return rows


def _relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.double() - b.double()).abs().max() / b.double().abs().max())


def _short(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def table(rows: list[Row]) -> str:
    """Markdown: a line a row."""
    cells = []
    for r in rows:
        measured, span, times = r.get("note", ""), "", ""
        if "ratio" in r:
            measured, span = f"{r['ratio']['median']:.3g}×", f"{r['ratio']['min']:.3g} … {r['ratio']['max']:.3g}"
            times = f"{r['ours_us']:.3g}, {r['other_us']:.3g}"
        elif "value" in r:
            measured = f"{r['value']:.2g} {r.get('unit', '')}".strip()
        met = {None: "", True: "yes", False: "**no**"}[r["met"]]
        cells.append([r["what"], measured, span, times, r["target"], met])
    return "\n".join(harness.table(("what", "measured", "range", "µs a step: ours, other", "target", "met"), cells))


PARTS = (against_hand, against_jax, long_rollout, other_formats, other_levels, derivatives)


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__, quick=True)
    parser.add_argument("--only", nargs="*", choices=[p.__name__ for p in PARTS], help="parts to run")
    arguments = parser.parse_args(argv)
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    path, found = harness.json_file(arguments, "stepper"), harness.conditions("jax", "onnxruntime")
    rows = []
    for part in (bar := tqdm([p for p in PARTS if not arguments.only or p.__name__ in arguments.only])):
        bar.set_description(part.__name__)
        rows += part(arguments.quick)
        harness.store(path, found | {"flags": FLAGS, "h": H, "quick": arguments.quick, "rows": rows}, table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
