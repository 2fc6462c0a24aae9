"""Run one experiment of `configs.py`: data → fit → save → verify → plot.

On several processes: torchrun --nproc-per-node 2 train/fit.py --config pendulum (the result is the same).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import torch

from configs import CONFIGS
from herglotz.errors import InputError
from herglotz.plots import save_figures
from herglotz.training import Run, fit, save_run
from herglotz.training.distributed import is_first, process_group
from herglotz.verify import verify


def main() -> int:
    # Small matrices are fastest on one thread.
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    about = "\n".join(f"  {name:15} {make().about}" for name, make in CONFIGS.items())
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=f"experiments:\n{about}", formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--config", required=True, choices=CONFIGS, help="which experiment")
    parser.add_argument("--seed", type=int, default=0, help="of the initial weights (default 0)")
    parser.add_argument("--out", type=Path, help="folder for the run (default runs/CONFIG)")
    parser.add_argument("--resume", action="store_true", help="go on from an interrupted run in that folder")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default cpu)")
    parser.add_argument("--dtype", default="float64", choices=("float64", "float32"), help="precision")
    arguments = parser.parse_args()
    experiment = CONFIGS[arguments.config]()
    device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if arguments.device == "cuda" else arguments.device
    settings = {"seed": arguments.seed, "device": device, "dtype": arguments.dtype}
    out = arguments.out or Path("runs") / arguments.config
    try:
        with process_group():
            out.mkdir(parents=True, exist_ok=True)
            run = fit(experiment.data(), replace(experiment.fit, **settings), out=out, resume=arguments.resume)
            first = is_first()
        return _report(run, out) if first else 0
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _report(run: Run, out: Path) -> int:
    save_run(run, out)
    print(json.dumps(run.metrics, indent=2))
    report = verify(run)
    print(report.table())
    save_figures(run, out)
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
