"""Speed and agreement of every form of a stepper: `python benchmarks/stepper.py [--quick] [--out FOLDER]`.

One thread, processor time (the rollout of 1e6 steps: time on the wall). What is compared is timed in turn within each
repeat, so that a busy machine slows both; a ratio is one of a single repeat, and the table gives their median and
range. Writes stepper.json, stepper.md and stepper.png.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import statistics
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm
from twins import func_step, hand_written, jax_rollout

import herglotz
from herglotz.errors import InputError
from herglotz.export import compile_c, export_c
from herglotz.export.c_header import c_source, read_metadata
from herglotz.export.c_stepper import CompiledStepper
from herglotz.export.c_wrapper import FLAGS, compiler
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper

ROOT = Path(__file__).resolve().parents[1]
H = 0.1
LEVELS = ("conservative", "linear", "affine", "forced", "full", "mass")
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


def seconds(run: Callable[[], Any], clock: Callable[[], float] = time.process_time) -> float:
    """Processor time of all threads: what another program takes from this one does not count."""
    begin = clock()
    with torch.no_grad():
        run()
    return clock() - begin


def alternate(ours: Callable[[], Any], other: Callable[[], Any], repeats: int, work: tuple[int, int]) -> Row:
    """µs a step and sample of both, and other / ours; `work` counts the steps · samples of each."""
    pairs = [(seconds(ours) / work[0], seconds(other) / work[1]) for _ in range(repeats + 1)][1:]  # the first warms up
    ratios = [b / a for a, b in pairs]
    return {
        "ours_us": 1e6 * statistics.median(a for a, _ in pairs),
        "other_us": 1e6 * statistics.median(b for _, b in pairs),
        "ratio": {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios)},
    }


def row(what: str, target: str, met: Callable[[float], bool] | None = None, **found: Any) -> Row:
    value = found["ratio"]["median"] if "ratio" in found else found.get("value")
    return {"what": what, "target": target, "met": None if met is None or value is None else met(value), **found}


def against_hand(quick: bool) -> list[Row]:
    rows = []
    for n in (1, 2, 8):
        for width, dtype in ((16, torch.float64), (64, torch.float32)):
            model = model_of(n, width, dtype=dtype)
            hand, ours = hand_written(model), compile_c(model, h=H)
            q, p, s = (x[0] for x in start(n, 1, dtype))
            steps = (2000 if quick else 20000) // (1 if width < 64 else 8) // (1 if n < 8 else 4)
            close = float((hand.rollout(q, p, s, H, 50) - ours.rollout(q, p, s, h=H, steps=50).q[1:]).abs().max())
            assert close < (1e-9 if dtype == torch.float64 else 1e-4), close
            timed = alternate(
                lambda q=q, p=p, s=s, ours=ours, steps=steps: ours.rollout(q, p, s, h=H, steps=steps),
                lambda q=q, p=p, s=s, hand=hand, steps=steps: hand.rollout(q, p, s, H, steps),
                3 if quick else 9,
                (steps, steps),
            )
            inverse = {k: 1 / v for k, v in timed["ratio"].items()}
            timed["ratio"] = {"median": inverse["median"], "min": inverse["max"], "max": inverse["min"]}
            what = f"C / hand-written C, n={n}, {width}x2, {_short(dtype)}, B=1"
            rows.append(row(what, "<= 1.3", lambda x: x <= 1.3, **timed))
    return rows


def against_jax(quick: bool) -> list[Row]:
    rows = []
    for batch, width, dtype in ((1, 16, torch.float64), (1, 64, torch.float32), (4096, 16, torch.float64),
                                (4096, 64, torch.float32)):  # fmt: skip
        model = model_of(2, width, dtype=dtype)
        what = f"JAX scan / C, n=2, {width}x2, {_short(dtype)}, B={batch}"
        target, least = (">= 4", 4.0) if batch == 1 else (">= 1.1", 1.1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            jax = jax_rollout(model, 2)
        if jax is None:
            rows.append(row(what, target, note="jax is not installed"))
            continue
        ours, state = compile_c(model, h=H), start(2, batch, dtype)
        steps = (2000 if quick else 10000) if batch == 1 else (10 if quick else 50)
        close = float((torch.as_tensor(np.array(jax(*state, H, steps)[-1])) - ours.rollout(*state, h=H, steps=steps)
                       .q[:, -1]).abs().max())  # fmt: skip
        timed = alternate(
            lambda s=state, o=ours, k=steps: o.rollout(*s, h=H, steps=k),
            lambda s=state, j=jax, k=steps: j(*s, H, k),
            3 if quick else 7,
            (steps * batch, steps * batch),
        )
        rows.append(row(what, target, lambda x, least=least: x >= least, difference=close, **timed))
    return rows


def long_rollout(quick: bool) -> list[Row]:
    steps = 100_000 if quick else 1_000_000
    rows = []
    for width in (0, 16):
        stepper, (q, p, s) = herglotz.compile(model_of(2, width)), (x[0] for x in start(2, 1, torch.float64))
        took = [seconds(lambda q=q, p=p, s=s, o=stepper: o.rollout(q, p, s, h=H, steps=steps), time.perf_counter)
                for _ in range(3)]  # fmt: skip
        what = f"hz.compile, 1e6 steps, n=2, float64, {f'{width}x2 correction' if width else 'no correction'}"
        scaled = statistics.median(took) * 1_000_000 / steps
        rows.append(row(what, "<= 8 s", lambda x: x <= 8, value=scaled, unit="s", steps_timed=steps))
    return rows


def other_formats(quick: bool) -> list[Row]:
    """ONNX and AOTInductor rollouts against our C: a small network, one whose products dominate, and no correction.

    The first six steps of a rollout have no history to guess from: long rollouts are timed, and a lone step apart.
    """
    from herglotz import export

    rows = []
    formats = {"ONNX": ("export_onnx", "load_onnx"), "AOTInductor": ("export_aoti", "load_pt2")}
    if quick:
        formats.pop("AOTInductor")  # compiles for a minute each
    for width, dtype in ((16, torch.float64), (64, torch.float32), (0, torch.float64)):
        model = model_of(2, width, dtype=dtype)
        ours, size = compile_c(model, h=H), f"n=2, {f'{width}x2' if width else 'explicit'}, {_short(dtype)}"
        for name, (write, read) in formats.items():
            with tempfile.TemporaryDirectory() as folder:
                try:
                    path = Path(folder, f"model.{'onnx' if name == 'ONNX' else 'pt2'}")
                    getattr(export, write)(model, path, h=H)
                    loaded = getattr(export, read)(path)
                except (AttributeError, InputError, ImportError, RuntimeError) as error:
                    note = f"not available: {str(error).splitlines()[0][:100]}"
                    rows += [row(f"{name} rollout / C, {size}, B={b}", "", note=note) for b in (1, 1024)]
                    continue
                for batch, most in ((1, 50.0), (1024, 2.5)):
                    steps = (16 if quick else 1000) if batch == 1 else (8 if quick else 80)
                    state, more = start(2, batch, dtype), 20 if batch == 1 else 1
                    timed = alternate(
                        lambda o=ours, s=state, k=steps * more: o.rollout(*s, h=H, steps=k),
                        lambda o=loaded, s=state, k=steps: o.rollout(*s, h=H, steps=k),
                        3 if quick else 5,
                        (steps * more * batch, steps * batch),
                    )
                    met = lambda x, most=most: x <= most  # noqa: E731
                    rows.append(row(f"{name} rollout / C, {size}, B={batch}", f"<= {most:g}", met, **timed))
                lone, alone = start(2, 1, dtype), 20 if quick else 200
                took = seconds(lambda o=loaded, s=lone, k=alone: [o.rollout(*s, h=H, steps=1) for _ in range(k)])
                rows.append(row(f"{name}, a rollout of one step, {size}, B=1", "", value=1e6 * took / alone, unit="µs"))
                if dtype == torch.float64:
                    rows.append(_agreement_row(name, model, loaded, 100 if quick else 1000))
    return rows


def other_levels(quick: bool) -> list[Row]:
    """The levels whose steps cost more, as ONNX against C: what couples all samples' Jacobians, forces, flows of s."""
    from herglotz.export import export_onnx, load_onnx

    rows = []
    for level in ("affine", "forced", "full", "mass"):
        model = model_of(2, 16, level)
        ours = compile_c(model, h=H)
        try:
            with tempfile.TemporaryDirectory() as folder:
                loaded = load_onnx(export_onnx(model, Path(folder, "model.onnx"), h=H))
        except (InputError, ImportError) as error:
            rows.append(row(f"ONNX rollout / C, n=2, {level}", "", note=f"not available: {str(error)[:100]}"))
            continue
        for batch, most in ((1, 50.0), (1024, 2.5)):
            steps = (8 if quick else 200) if batch == 1 else (4 if quick else 20)
            state, more = start(2, batch, torch.float64), 20 if batch == 1 else 1
            timed = alternate(
                lambda o=ours, s=state, k=steps * more: o.rollout(*s, h=H, steps=k),
                lambda o=loaded, s=state, k=steps: o.rollout(*s, h=H, steps=k),
                3 if quick else 5,
                (steps * more * batch, steps * batch),
            )
            met = lambda x, most=most: x <= most  # noqa: E731
            rows.append(row(f"ONNX rollout / C, n=2, {level}, 16x2, float64, B={batch}", f"<= {most:g}", met, **timed))
    return rows


def _agreement_row(name: str, model: ContactLagrangian, form: Any, steps: int) -> Row:
    """The last state of a form of the model against that of the eager stepper."""
    state = start(2, 2, torch.float64)
    with torch.no_grad():
        ours, eager = (o.rollout(*state, h=H, steps=steps) for o in (form, Stepper(model, tol=4e-16)))
    worst = max(_relative(getattr(ours, x), getattr(eager, x)) for x in "qps")
    return row(f"{name} against eager over {steps} steps, float64", "<= 1e-12", lambda x: x <= 1e-12, value=worst)


def eager_rows(quick: bool) -> list[Row]:
    rows = []
    model = model_of(2, 16)
    state, stepper, func = start(2, 1, torch.float64), Stepper(model_of(2, 16)), func_step(model, 3)
    few = 3 if quick else 10
    timed = alternate(
        lambda: [stepper.step(state, H) for _ in range(few)], lambda: [func(state, H) for _ in range(few)],
        3 if quick else 7, (few, few),
    )  # fmt: skip
    rows.append(row("torch.func step / eager step, n=2, 16x2, B=1", ">= 15", lambda x: x >= 15, **timed))
    for n in (1, 2, 8):
        model, state = model_of(n, 0), start(n, 1, torch.float64)
        forms = Stepper(model), Stepper(model, explicit=False)
        steps = 30 if quick else 200
        timed = alternate(
            lambda f=forms, s=state, k=steps: f[0].rollout(*s, h=H, steps=k),
            lambda f=forms, s=state, k=steps: f[1].rollout(*s, h=H, steps=k), 3 if quick else 7, (steps, steps),
        )  # fmt: skip
        rows.append(row(f"Newton / explicit step, eager, n={n}, B=1", ">= 4", lambda x: x >= 4, **timed))
        with tempfile.TemporaryDirectory() as folder:
            text = export_c(model, Path(folder, "a.h"), h=H).read_text()
        newton = CompiledStepper(c_source(model, read_metadata(text, ""), "a.h", explicit=False))
        ours, one, many = compile_c(model, h=H), State(*(x[0] for x in state)), 5000 if quick else 50000
        timed = alternate(
            lambda o=ours, s=one, k=many: o.rollout(*s, h=H, steps=k),
            lambda o=newton, s=one, k=many: o.rollout(*s, h=H, steps=k), 3 if quick else 9, (many, many),
        )  # fmt: skip
        what = f"Newton / explicit step, C, n={n}, B=1 (Newton starts at the solution: one evaluation, no more)"
        rows.append(row(what, ">= 2", lambda x: x >= 2, **timed))
    return rows


def agreement(quick: bool) -> list[Row]:
    """C against eager after 1000 steps of a damped scene; float32 against float64 with the same weights."""
    rows, steps = [], 100 if quick else 1000
    for level in LEVELS:
        model = model_of(2, 6, level)
        state = start(2, 2, torch.float64)
        try:
            ours = compile_c(model, h=H)
        except InputError as error:
            rows.append(row(f"C against eager, {level}", "<= 1e-12", note=str(error).split(";")[0]))
            continue
        with torch.no_grad():
            eager = Stepper(model, tol=4e-16).rollout(*state, h=H, steps=steps)
        worst = max(_relative(a, b) for a, b in zip(ours.rollout(*state, h=H, steps=steps).final, eager.final,
                                                     strict=True))  # fmt: skip
        rows.append(row(f"C against eager after {steps} steps, {level}, float64", "<= 1e-12", lambda x: x <= 1e-12,
                        value=worst))  # fmt: skip
        single, h = model_of(2, 6, level).float(), float(torch.tensor(H))
        small = State(*(x.float() for x in state))
        exact = compile_c(model_of(2, 6, level).float().double(), h=h)
        exact = exact.rollout(*(x.double() for x in small), h=h, steps=steps).final
        for name, form in (("C", compile_c(single, h=H)), ("eager", Stepper(single))):
            with torch.no_grad():
                out = form.rollout(*small, h=H, steps=steps).final
            worst = max(_relative(a, b) for a, b in zip(out, exact, strict=True))
            what = f"{name} float32 against float64 after {steps} steps, {level}"
            rows.append(row(what, "<= 1e-5", lambda x: x <= 1e-5, value=worst))
    return rows


def sizes(quick: bool) -> list[Row]:
    """Time and memory over n and B."""
    rows = []
    for n in (1, 8) if quick else (1, 2, 4, 8, 16, 32, 64):
        model = model_of(n, 16)
        ours, eager = compile_c(model, h=H), Stepper(model)
        for batch in (1, 256) if quick else (1, 16, 256, 4096, 65536):
            steps = max(2, min(2000, 400_000 // (batch * n * n)))
            state, repeats = start(n, batch, torch.float64), 3 if n * batch <= 8 * 65536 else 1
            took = min(seconds(lambda o=ours, s=state, k=steps: o.rollout(*s, h=H, steps=k)) for _ in range(repeats))
            found = {"n": n, "B": batch, "c_us": 1e6 * took / steps / batch, "steps": steps}
            found["output_bytes_per_trajectory"] = 8 * ((steps + 1) * (2 * n + 2) + steps) + steps
            found["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            if batch <= 256 and n <= 8:
                eager_took = min(seconds(lambda e=eager, s=state: e.rollout(*s, h=H, steps=3)) for _ in range(2))
                found["eager_us"] = 1e6 * eager_took / 3 / batch
            rows.append(found)
    return rows


def exponents(curve: list[Row]) -> list[Row]:
    """The x of time ~ B^x for each n, by least squares over B >= 256, where the cost of a call is nothing."""
    rows = []
    for n in sorted({r["n"] for r in curve}):
        mine = [(math.log(r["B"]), math.log(r["B"] * r["c_us"])) for r in curve if r["n"] == n and r["B"] >= 256]
        if len(mine) > 1:
            x = statistics.linear_regression(*zip(*mine, strict=True)).slope
            largest = max(r["B"] for r in curve if r["n"] == n)
            what = f"C, time ~ B^x from B=256 to {largest}, n={n}: x"
            rows.append(row(what, "0.9 … 1.1", lambda x: 0.9 <= x <= 1.1, value=x))
    return rows


def gpu(quick: bool) -> list[Row]:
    """Eager, compiled and CUDA-graph steps as a fraction of the measured rate of matrix products."""
    if not torch.cuda.is_available():
        return [row("GPU step", "reported", note="no GPU on this machine")]
    device, rows = torch.device("cuda"), []
    model = model_of(2, 64, dtype=torch.float32).to(device).requires_grad_(False)
    a = torch.randn(8192, 4096, device=device)
    rate = 2 * 8192 * 4096**2 / _cuda_seconds(lambda: a @ a[:4096])
    from herglotz.export import StepModule

    step = StepModule(model, 4)
    # evaluations · multiply-add · (value, gradient, two tangents of both) · weights
    flops = 4 * 2 * 6 * (7 * 64 + 64 * 64)
    for batch in (1000, 10_000) if quick else (1000, 10_000, 100_000, 1_000_000):
        state = State(*(x.to(device) for x in start(2, batch, torch.float32)))
        h = torch.full((batch,), H, device=device)
        forms: dict[str, Callable[[], Any]] = {"eager": lambda s=state, h=h: step(*s, h)}
        compiled = torch.compile(step)
        forms["compiled"] = lambda s=state, h=h, c=compiled: c(*s, h)
        with torch.no_grad():
            for _ in range(3):
                step(*state, h)
            torch.cuda.synchronize()
            graph = torch.cuda.CUDAGraph()
            try:
                with torch.cuda.graph(graph):
                    step(*state, h)
                forms["CUDA graph"] = graph.replay
            except RuntimeError as error:
                rows.append(row(f"GPU CUDA graph, B={batch}", "reported", note=str(error).splitlines()[0][:100]))
        for name, form in forms.items():
            took = _cuda_seconds(form)
            found = {"value": took * 1e3, "unit": "ms", "fraction_of_gemm": flops * batch / took / rate}
            rows.append(row(f"GPU {name} step, n=2, 64x2, float32, B={batch}", "reported", **found))
    return rows


def _cuda_seconds(run: Callable[[], Any], repeats: int = 10) -> float:
    with torch.no_grad():
        for _ in range(3):
            run()
        torch.cuda.synchronize()
        begin = time.perf_counter()
        for _ in range(repeats):
            run()
        torch.cuda.synchronize()
    return (time.perf_counter() - begin) / repeats


def _relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.double() - b.double()).abs().max() / b.double().abs().max())


def _short(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def conditions() -> Row:
    """Machine, load and versions."""
    words = [*compiler(), "--version"]
    version = subprocess.run(words, capture_output=True, text=True, check=False).stdout.splitlines()
    versions = {"torch": torch.__version__, "python": platform.python_version(), "compiler": version[0]}
    for name in ("jax", "onnxruntime"):
        try:
            versions[name] = __import__(name).__version__
        except ImportError:
            versions[name] = "not installed"
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    processor = next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), platform.machine())
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout
    machine = {"processor": processor, "cores": os.cpu_count(), "threads": 1, "load_before": os.getloadavg()}
    return {"commit": commit.strip(), "machine": machine, "versions": versions, "flags": FLAGS, "h": H}


def table(rows: list[Row]) -> str:
    lines = ["| what | measured | range | µs a step: ours, other | target | met |", "|---|---|---|---|---|---|"]
    for r in rows:
        measured, span, times = r.get("note", ""), "", ""
        if "ratio" in r:
            measured, span = f"{r['ratio']['median']:.3g}×", f"{r['ratio']['min']:.3g} … {r['ratio']['max']:.3g}"
            times = f"{r['ours_us']:.3g}, {r['other_us']:.3g}"
        elif "value" in r:
            measured = f"{r['value']:.2g} {r.get('unit', '')}".strip()
        met = {None: "", True: "yes", False: "**no**"}[r["met"]]
        lines.append(f"| {r['what']} | {measured} | {span} | {times} | {r['target']} | {met} |")
    return "\n".join(lines)


def plot(curve: list[Row], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for n in sorted({r["n"] for r in curve}):
        mine = [r for r in curve if r["n"] == n]
        axes.loglog([r["B"] for r in mine], [r["c_us"] for r in mine], "o-", label=f"n = {n}")
    axes.set(xlabel="batch size B", ylabel="µs a step and trajectory", title="Compiled step, 16x2 correction, float64")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)


def main() -> None:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a test run: shorter, fewer sizes")
    parser.add_argument("--only", nargs="*", help="names of parts to run, e.g. against_hand sizes")
    parser.add_argument("--out", type=Path, help="folder for stepper.json, .md and .png, e.g. benchmarks/results")
    arguments = parser.parse_args()
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    parts = [against_hand, against_jax, long_rollout, other_formats, other_levels, eager_rows, agreement, gpu]
    chosen = [p for p in parts if not arguments.only or p.__name__ in arguments.only]
    begin, found, rows = time.perf_counter(), conditions(), []
    bar = tqdm(chosen)
    for part in bar:
        bar.set_description(part.__name__)
        rows += part(arguments.quick)
    curve = sizes(arguments.quick) if not arguments.only or "sizes" in arguments.only else []
    rows += exponents(curve)
    found["machine"]["load_after"] = os.getloadavg()
    text = table(rows)
    print(text)
    for r in curve:
        print({k: round(v, 3) for k, v in r.items()})
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        found |= {"quick": arguments.quick, "seconds": time.perf_counter() - begin, "rows": rows, "sizes": curve}
        (arguments.out / "stepper.json").write_text(json.dumps(found, indent=1) + "\n")
        (arguments.out / "stepper.md").write_text(text + "\n")
        if curve:
            plot(curve, arguments.out / "stepper.png")


if __name__ == "__main__":
    main()
