"""How long one step of a C header takes at worst: `python benchmarks/worst_case.py [--steps 10000000] [--out FOLDER]`.

Steps from random states of the box that the header records, and along motions inside it, each the shortest of three
tries from the same state; the 10 000 longest are tried again 300 times. Evaluations of the step equation are counted,
and are exact. Then, where an Arm compiler and emulator are there, flash, RAM and instructions of the same models in
float on a Cortex-M4 (`examples/cortex_m4`). 1e7 steps of all rows take two minutes of processor time.
Writes worst_case.json and worst_case.md.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.stepper import model_of
from herglotz.codegen.c_compiler import FLAGS
from herglotz.export import export_c
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Stepper

EXAMPLE = harness.ROOT / "examples" / "cortex_m4"
NUMBERS = ("median", "q9999", "worst", "evaluations_median", "evaluations_q9999", "evaluations_worst", "failed")
Row = dict[str, Any]


def network_pendulum() -> tuple[ContactLagrangian, float]:
    """A damped pendulum with a random network of two layers of 16 units; 63 steps a period."""
    return model_of(1), 0.1


def double_pendulum() -> tuple[ContactLagrangian, float]:
    """Two links by named terms, 70 steps a period of the first."""
    ones = (1.0, 1.0)
    config = ModelConfig((True, True), "linear", ones, (3.0, 3.0), (9.0, 5.0), (0.0, 0.0), 0.1, potential_width=0,
                         features=("cos(q1 - q2) v1 v2",))  # fmt: skip
    model = ContactLagrangian(config)
    with torch.no_grad():
        model.get_parameter("kinetic.sum.coefficient").fill_(0.5)
    return model, 0.03


def dry_friction() -> tuple[ContactLagrangian, float]:
    """A driven mass on a spring that dry friction can hold."""
    config = ModelConfig((False,), "forced", potential_width=0, coulomb=True, sticking=True, inputs=1, input_map=(1.0,))
    model = ContactLagrangian(config)
    with torch.no_grad():
        model.get_parameter("friction.coulomb").fill_(0.3)
        model.get_parameter("friction.breakaway").fill_(0.1)
    return model, 0.1


MODELS = {
    "pendulum, 16x2 network": network_pendulum,
    "double pendulum, named terms": double_pendulum,
    "driven mass, dry friction": dry_friction,
}


def box_of(model: ContactLagrangian, h: float) -> dict[str, list[float]]:
    """The range of 16 motions of 400 steps: |q| <= 2 at the start, |p| <= 1."""
    n, make = model.config.dof, torch.Generator().manual_seed(1)
    q, p = (torch.rand(16, n, generator=make, dtype=torch.float64).mul(2 * x).sub(x) for x in (2.0, 1.0))
    u = torch.rand(16, 400, 1, generator=make, dtype=torch.float64).mul(2).sub(1) if model.inputs else None
    with torch.no_grad():
        motion = Stepper(model).rollout(q, p, torch.zeros(16, dtype=torch.float64), h=h, steps=400, inputs=u)
    assert bool(motion.ok.all())
    ends = {"low": torch.Tensor.amin, "high": torch.Tensor.amax}
    return {
        f"{name}_{end}": cut(getattr(motion, name).reshape(16 * 401, -1), 0).tolist()
        for name in "qps"
        for end, cut in ends.items()
    }


def header(name: str, folder: Path, prefix: str, dtype: str) -> str:
    """The header of a model, which is written to the folder."""
    model, h = MODELS[name]()
    return export_c(model, folder / f"{prefix}.h", h=h, dtype=dtype, box=box_of(model, h)).read_text()


def times(name: str, along: bool, steps: int) -> Row:
    """Times in ns and evaluations of steps along motions, or from random states."""
    with tempfile.TemporaryDirectory() as folder:
        text = header(name, Path(folder), "model", "float64")
    text, counted = re.subn(r"model_evaluate(?:_first)?\(P, t\)(?=;)", r"(evaluations++, \g<0>)", text)
    assert counted == 3
    found = (ctypes.c_long * 7)()
    library = harness.compiled("worst_case.c", "model.h", text, *FLAGS)
    library.measure(ctypes.c_long(steps), int(along), ctypes.c_uint64(1), found)
    states = "along motions" if along else "random"
    return {"model": name, "states": states, "steps": steps, **dict(zip(NUMBERS, found, strict=True))}


def on_cortex_m4(name: str) -> Row:
    """Flash and RAM in bytes, and instructions of a step."""
    with tempfile.TemporaryDirectory() as folder:
        header(name, Path(folder), "stepper", "float32")
        build = Path(folder, "build")
        command = ["make", "-s", "-C", str(EXAMPLE), f"HEADER={folder}/stepper.h", f"BUILD={build}", "measure"]
        words = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return {"model": name} | {key: int(value) for key, value in re.findall(r"^(\w+) +(\d+)$", words, re.MULTILINE)}


def table(rows: list[Row], small: list[Row]) -> str:
    """Markdown: times as multiples of the median, and evaluations; what a Cortex-M4 needs."""
    head = ("model", "states", "steps", "median", "99.99 %", "worst", "evaluations: median, 99.99 %, worst", "failed")
    cells = []
    for r in rows:
        middle = max(r["median"], 1)
        counts = ", ".join(str(r[f"evaluations_{x}"]) for x in ("median", "q9999", "worst"))
        ratios = (f"{r[x] / middle:.2f} ×" for x in ("q9999", "worst"))
        cells.append((r["model"], r["states"], f"{r['steps']:.0e}", f"{middle} ns", *ratios, counts, r["failed"]))
    lines = harness.table(head, cells)
    if small:
        head = ("float, Cortex-M4", "flash, bytes", "RAM, bytes", "of it stack", "instructions a step: mean, most")
        cells = [(r["model"], r["flash"], r["ram"], r["stack"], f"{r['mean']}, {r['most']}") for r in small]
        lines += ["", *harness.table(head, cells)]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--steps", type=lambda text: int(float(text)), default=10_000_000, help="of each row (1e7)")
    arguments = parser.parse_args(argv)
    path = harness.json_file(arguments, "worst_case")
    there = all(map(shutil.which, ("arm-none-eabi-gcc", "qemu-system-arm", "make")))
    small = [on_cortex_m4(name) for name in MODELS] if there else []
    jobs = [(name, along) for name in MODELS for along in (False, True)]
    rows = [times(*job, arguments.steps) for job in tqdm(jobs)]
    text = table(rows, small)
    harness.store(path, harness.conditions() | {"flags": FLAGS, "rows": rows, "cortex_m4": small}, text)
    print(text)


if __name__ == "__main__":
    main()
