"""`herglotz export`: write the model of a run as one file that steps without this package."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.cli.common import (
    KICKS,
    check_output_file,
    flag,
    import_torch,
    positive,
    print_json,
    print_next,
    say,
    warn_of_misfit,
)
from herglotz.cli.flags import FORCE
from herglotz.errors import InputError, refuse
from herglotz.formats import FORMATS, endings, of_ending

if TYPE_CHECKING:
    from herglotz.training import Run

KNOWN = "\n".join(f"  {name:8}{form.words}" for name, form in FORMATS.items())
DESCRIPTION = f"""\
Write the model of a run as one file; every format checks its own steps and reports a residual and a status.

{KNOWN}

examples:
  herglotz export runs/pendulum --out pendulum.pt2
  herglotz export runs/pendulum --out stepper.onnx
  herglotz export runs/pendulum --format aoti --out stepper.aoti.pt2
  herglotz export runs/pendulum --out stepper.h
  herglotz export runs/pendulum --format casadi --out pendulum.c
  herglotz export runs/pendulum --out pendulum.fmu
"""


HELP = "write a model as one file"
FLAGS = (
    flag("source", "folder that `herglotz fit` wrote", metavar="RUN", type=Path),
    flag("--out", f"file to write, ending in {', '.join(endings())}", required=True, type=Path, metavar="FILE"),
    flag("--format", "kind of file (default: as the name says)", choices=tuple(FORMATS)),
    flag("--h-range", "range of steps h (default: that of the data); C flags other steps, Python refuses them",
         type=positive, nargs=2, metavar=("LOW", "HIGH")),
    flag("--name", "what every name in a C header begins with, so that headers of two models fit into one program "
         "(default: the name of the file)", metavar="PREFIX"),
    flag("--dtype", "numbers of the C: float32 for a microcontroller (default float64, or what tune chose)",
         choices=("float64", "float32")),
    flag("--parameters", "numbers of the model that a C program sets at run time, friction.viscous[0] or "
         "friction.viscous for all of them, with bounds if wanted: damping.rate=0:2", nargs="+",
         metavar="NAME[=LOW:HIGH]"),
    flag("--between", "a number NAME of --parameters that moves all numbers of the model at once, as a payload does: 0 "
         "is this run and 1 is that one, a fit of the same terms", metavar="NAME=RUN"),
    flag("--extras", "what else a C header holds: adjoint (vector-Jacobian products of steps and rollouts), filter "
         "(a Kalman filter with the noise of the fit)", nargs="+", choices=("adjoint", "filter")),
    flag("--unroll", "ONNX of a single step without a loop: how many of Newton's iterations it makes (6 suits most "
         "models)", type=int, metavar="N"),
    FORCE,
    flag("--json", "print what was written as JSON", action="store_true"),
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Export, read the file again and report."""
    form: str | None = arguments.format or of_ending(arguments.out.suffix)
    check_output_file(arguments.out, endings() if form is None else (FORMATS[form].ending,), arguments.force)
    assert form is not None
    kicks = arguments.source / KICKS
    if kicks.is_file() and form == "c":
        return _copy_kicks(arguments, kicks)
    import_torch()

    from herglotz.training import load_run

    run = load_run(arguments.source)

    from herglotz.export import export_run, load_exported
    from herglotz.export.load import read_header
    from herglotz.export.parameters import between, parsed

    if arguments.between is not None:
        name, _, other = arguments.between.partition("=")
        if not other:
            raise InputError(f"--between takes NAME=RUN, as in payload=runs/loaded, got '{arguments.between}'")
        run = between(run, name, load_run(Path(other)))

    warn_of_misfit(run, "the file will not step as the recorded system does")
    settings = {name: getattr(arguments, name) for name in ("h_range", "name", "dtype", "unroll")}
    settings |= {"parameters": parsed(arguments.parameters or ()), "extras": arguments.extras or ()}
    export_run(run, arguments.out, form, **settings)
    # C is read, not compiled, so that this machine needs no compiler.
    is_c = FORMATS[form].is_c
    metadata = read_header(arguments.out)[1] if is_c else load_exported(arguments.out).metadata
    if arguments.json:
        print_json({"file": str(arguments.out), "bytes": arguments.out.stat().st_size, "metadata": metadata})
    else:
        _report(run, form, metadata, arguments)
    return 0


def _report(run: Run, form: str, metadata: dict[str, Any], arguments: argparse.Namespace) -> None:
    """Print size and kind of the file, what it leaves out of the choice of `herglotz tune`, and the next command."""
    out: Path = arguments.out
    dof = f"{metadata['dof']} coordinate{'' if metadata['dof'] == 1 else 's'}"
    print(f"{out}: {out.stat().st_size / 1024:.0f} KiB, {metadata['dtype']}, {dof}, h {run.h:g}")
    if (arguments.source / KICKS).is_file():
        print(f"tune chose kicks, which exist in C only (--format c); {out} holds the run's own model")
    if not FORMATS[form].is_c and (tol := run.setting.get("tol")):
        print(f"The tolerance {tol:g} of tune applies to PyTorch and C only; this file solves to rounding")
    if form == "c":
        say(f"The example at the top of {out} compiles with cc -O3 -march=native")
    print_next(["verify", out, "--against", arguments.source])


def _copy_kicks(arguments: argparse.Namespace, kicks: Path) -> int:
    """Copy the header of kicks that `herglotz tune` wrote; return the exit code 0."""
    from herglotz.data.files import write_atomically

    refuse({
        "--name: kicks that tune chose have the prefix herglotz_kicks; leave --name out": arguments.name is not None,
        "--dtype: tune chose the dtype of its kicks; leave --dtype out": arguments.dtype is not None,
        "--parameters, --extras: kicks that tune chose have neither; leave them out":
            arguments.parameters is not None or arguments.extras is not None,
    })  # fmt: skip
    text = kicks.read_bytes()
    write_atomically(arguments.out, text)
    if arguments.json:
        print_json({"file": str(arguments.out), "bytes": len(text), "kicks": True})
    else:
        print(f"{arguments.out}: {len(text) / 1024:.0f} KiB, the large step of kicks that tune chose")
        print("Next: include it and call herglotz_kicks_step in a loop, with cc -O3 -march=native")
    return 0
