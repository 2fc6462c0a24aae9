"""`herglotz verify`: measure the identities of the theory."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from herglotz.cli.common import check_output_folder, count, flag, import_torch, positive, print_json, seed
from herglotz.cli.flags import TRUST
from herglotz.errors import InputError, refuse
from herglotz.formats import FORMATS, of_ending

DESCRIPTION = """\
Measure every identity that a discrete contact Lagrangian must satisfy on a scene, a run or an exported file, and
compare each with its tolerance. The exit code is 0 when all pass and 1 when one fails. A file without derivatives
(aoti) is differentiated by differences of order 8, with wider tolerances.
A file is also stepped beside its run, 1, 7 and 4096 samples over 1000 steps. The run is the one that --against
names, or a folder with the same weights beside the file, in the current folder, or in runs/ of either.

examples:
  herglotz verify damped_oscillator
  herglotz verify kepler --symmetries
  herglotz verify runs/pendulum --json
  herglotz verify stepper.onnx --against runs/pendulum
"""
# The largest difference after 1000 steps, relative to the largest value, is at most this: steps amplify rounding.
MAX_DIFFERENCE = {"float64": 1e-9, "float32": 1e-3}

HELP = "check the identities of the theory"
FLAGS = (
    flag("target", "a scene, the folder of a run, or an exported file", metavar="SCENE|RUN|FILE"),
    flag("--h", "step (default: the scene's or the model's own)", type=positive),
    flag("--samples", "states to check at (default 64, and fewer beyond 10 coordinates)", type=count),
    flag("--steps", "steps of the checks along motions (default %(default)s)", type=count, default=8),
    flag("--seed", "seed of the states (default %(default)s)", type=seed, default=0),
    flag("--against", "run that a file was exported from (default: a run with its weights nearby)",
         type=Path, metavar="RUN"),
    flag("--plots", "draw the identities of S^k of a SCENE or RUN too", type=Path, metavar="FOLDER"),
    flag("--symmetries", "find translations, rotations and their momenta J of a SCENE or RUN", action="store_true"),
    TRUST,
    flag("--json", "print the report as JSON, and nothing else", action="store_true"),
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Verify and report; return 1 if a check fails, else 0."""
    refuse({
        "--samples must be >= 1, got 0": arguments.samples == 0,
        f"--steps must be >= 2, got {arguments.steps}": arguments.steps < 2,
    })  # fmt: skip
    import_torch()
    target = arguments.target
    if Path(target).is_file():
        target, arguments.against = _opened(Path(target), arguments)
    elif arguments.against is not None:
        raise InputError(f"--against compares an exported file with a run; {target} is no file")

    from herglotz.verify import symmetries, verify

    if arguments.plots is not None:
        from herglotz.plots import save_theory_figures

        check_output_folder(arguments.plots)
        save_theory_figures(arguments.target, arguments.plots, h=arguments.h)
    settings = {name: getattr(arguments, name) for name in ("h", "samples", "steps", "seed")}
    model = _model_of(target, arguments)
    report = verify(target, model=model, **settings)
    found = symmetries(target, h=arguments.h, seed=arguments.seed) if arguments.symmetries else None
    agreement = None if arguments.against is None else _agreement(target, arguments)
    passed = report.passed and (agreement is None or agreement["passed"])
    if arguments.json:
        more = {} if found is None else {"symmetries": found.to_dict()}
        more |= {} if agreement is None else {"passed": passed, "against": agreement}
        print_json({**report.to_dict(), **more})
    else:
        print(_text(report, found, agreement, arguments))
    return int(not passed)


def _model_of(target: Any, arguments: argparse.Namespace) -> Any:
    """The model of the run of --against; None without one, InputError if that is not the run of the file."""
    from herglotz.training import load_run

    if arguments.against is None:
        return None
    model = load_run(arguments.against).model.to(target.dtype)
    if (model.dof, model.inputs) != (target.dof, target.inputs):
        raise InputError(
            f"--against {arguments.against}: the run has {model.dof} coordinate(s) and {model.inputs} input(s), "
            f"{arguments.target} has {target.dof} and {target.inputs}; give the run that the file was exported from"
        )
    return model


def _text(report: Any, found: Any, agreement: dict[str, Any] | None, arguments: argparse.Namespace) -> str:
    """The report, the symmetries, and the comparison of a file with its run, as text."""
    alone = agreement is None and report.passed and Path(arguments.target).is_file()
    verdict = "its identities hold; its numbers are not verified" if alone else ""
    if agreement is not None and not agreement["passed"]:
        verdict = "NOT verified"
    parts = [report.table(verdict)] + ([] if found is None else [str(found)])
    if agreement is not None:
        parts.append(_table(agreement, arguments.against))
    elif Path(arguments.target).is_file():
        parts.append("not compared with its model: no run with these weights was found; name it with --against RUN")
    return "\n".join(parts)


def _opened(path: Path, arguments: argparse.Namespace) -> tuple[Any, Path | None]:
    """The stepper of an exported file, and the run to compare the file with: that of --against, or one nearby.

    A C header is trusted without --trust-code if its run is found and generates the same text.
    """
    from herglotz.export import load_c, load_exported
    from herglotz.export.load import read_header
    from herglotz.training import load_run

    if path.suffix.lower() in (".csv", ".npz", ".txt"):
        raise InputError(f"{path}: is data, not a model; fit it first: herglotz fit {path} --out RUN")
    form = FORMATS.get(of_ending(path.suffix) or "")
    if form is None or not form.is_c:
        stepper = load_exported(path, trust_code=arguments.trust_code)
        return stepper, arguments.against or _exported_from(stepper.metadata, path)
    against = arguments.against or _exported_from(read_header(path)[1], path)
    model = None if against is None else load_run(against).model
    return load_c(path, trust_code=arguments.trust_code, model=model), against


def _exported_from(metadata: dict[str, Any], file: Path) -> Path | None:
    """Return a run with the weights of the file, from a folder near the file or the current one."""
    from herglotz.export import weights_digest
    from herglotz.training import load_run

    for folder in dict.fromkeys((file.parent, file.parent / "runs", Path(), Path("runs"))):
        for model in sorted(folder.glob("*/model.pt")):
            try:
                if weights_digest(load_run(model.parent).model) == metadata["weights_sha256"]:
                    return model.parent
            # A model.pt of another program is no run.
            except InputError:
                continue
    return None


def _agreement(target: Any, arguments: argparse.Namespace) -> dict[str, Any]:
    """Step the file beside the run's own stepper; return the differences and whether they are within the bound."""
    from herglotz.export import compare
    from herglotz.stepping import State
    from herglotz.training import load_run

    run = load_run(arguments.against)
    states = State(*(x.to(target.dtype) for x in run.states))
    states = State(*(x[states.finite] for x in states))
    result = compare(target, run.stepper, h=arguments.h, states=states, seed=arguments.seed)
    bound = MAX_DIFFERENCE[target.metadata["dtype"]]
    close = all(result[name] <= bound for name in "qpsc")
    other = other_metadata(target.metadata, run)
    passed = close and result["status"] == 0 and result["same_weights"] is not False and not other
    return {**result, "bound": bound, "other_metadata": other, "passed": passed}


def other_metadata(metadata: dict[str, Any], run: Any) -> list[str]:
    """Names of the entries about the model that differ between a file and its run."""
    config = run.model.config
    expected = {"level": config.level, "dof": config.dof, "model": config.to_dict()}
    # Through JSON tuples become lists, as in the file.
    found, wanted = (json.loads(json.dumps({name: x[name] for name in expected})) for x in (metadata, expected))
    return [name for name in expected if found[name] != wanted[name]]


def _table(agreement: dict[str, Any], against: Path | None) -> str:
    """The differences of a file from its run as a text table, one row a batch size."""
    lines = [f"beside {against}, 1000 steps:", "largest difference, relative to the largest value"]
    lines.append(f"  {'batch':>6}" + "".join(f"  {name:>9}" for name in "qpsc") + "  failed  other status")
    for size, one in agreement["per_batch"].items():
        numbers = "".join(f"  {one[name]:>9.2g}" if math.isfinite(one[name]) else f"  {'none':>9}" for name in "qpsc")
        lines.append(f"  {size:>6}{numbers}  {one['failed']:>6}  {one['status']:>12}")
    if agreement["same_weights"] is False:
        lines.append("  the weights of the file are not those of the run")
    if agreement["other_metadata"]:
        lines.append(f"  the file does not say what the run says of: {', '.join(agreement['other_metadata'])}")
    lines.append(f"  {'agrees' if agreement['passed'] else 'DOES NOT AGREE'} (bound {agreement['bound']:g})")
    return "\n".join(lines)
