"""`make demo`: positions → trained model → stepper file → verification table → pictures, in a few minutes."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import torch

from configs import demo
from herglotz.export import export_pt2
from herglotz.plots import save_figures
from herglotz.training import fit, save_run
from herglotz.verify import verify

OUT = Path("runs/demo")


def main() -> int:
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))  # small matrices: more threads only wait
    started = time.perf_counter()
    experiment = demo()
    data = experiment.data()
    print(f"1  data     {data.summary()}")
    OUT.mkdir(parents=True, exist_ok=True)
    run = fit(data, experiment.fit, out=OUT)
    save_run(run, OUT)
    m = run.metrics
    print(f"2  fit      {m['objective']} objective, {m['parameters']} parameters, {m['seconds']:.0f} s")
    print(f"            extrapolation RMS {m['extrapolation_rms']:.4f} rad over the unseen third of every trajectory")
    export_pt2(run.model, OUT / "stepper.pt2", h=run.h, box=run.box, units=run.data.units)
    print(f"3  export   {OUT / 'stepper.pt2'}: loads and steps with torch alone")
    reports = [verify(run), verify(OUT / "stepper.pt2")]
    print("4  verify")
    for report in reports:
        print(report.table())
    pictures = save_figures(run, OUT)
    print("5  pictures " + "  ".join(str(path) for path in pictures))
    print(f"done in {time.perf_counter() - started:.0f} s")
    return 0 if all(report.passed for report in reports) else 1


if __name__ == "__main__":
    sys.exit(main())
