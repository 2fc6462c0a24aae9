"""`export_run`: a run as one file, with the run's names, units, start and metrics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from herglotz.errors import InputError, refuse
from herglotz.export.filtering import noise_of
from herglotz.export.parameters import Chosen, described_parameters
from herglotz.formats import FORMATS, endings, of_ending
from herglotz.training import Run
from herglotz.training.summary import model_card

# Relative rounding error of steps that are differences of recorded times: a clock's 0.001 s and 0.00099999999999989 s
# are one step.
ROUNDING = 1e-6


def export_run(
    run: Run,
    path: str | Path,
    kind: str | None = None,
    *,
    h_range: tuple[float, float] | None = None,
    name: str | None = None,
    dtype: str | None = None,
    parameters: Chosen = (),
    extras: Sequence[str] = (),
    unroll: int | None = None,
) -> Path:
    """Write the model of a run as one file that steps without this package.

    Parameters
    ----------
    run
        What `fit` returned.
    path
        File ending in .pt2, .onnx, .h, .c or .fmu.
    kind
        A name in `herglotz.formats.FORMATS`: "pt2", "onnx", "aoti", "c", "casadi", "acados", "fmu" (FMI 3.0) or "fmu2"
        (2.0); None: by the end of the name.
    h_range
        Shortest and longest step of the file; None: the steps of the fit and of the recording, which a fit may cross
        in several steps. The file takes steps that equal these to six digits, too: recorded times are rounded, and 0.2
        also means 0.2000000000000002.
    name
        Prefix of every name in C, as in `export_c`, and the identifier of an FMU; None: the file's name.
    dtype
        Type of the numbers in C, "float64" or "float32"; None: float64, or the choice of `herglotz tune`.
    parameters
        Numbers that a C header takes at run time, as in `export_c`.
    extras
        Further functions of a C header, as in `export_c`; a filter has the noise of the fit as `NAME_noise_of_fit`.
    unroll
        Newton's iterations of an ONNX file of a single step without a loop, as in `export_onnx`.

    Raise InputError if the name has another end, the format cannot hold the model, or an argument is not one of this
    format.
    """
    path = Path(path)
    kind = kind or of_ending(path.suffix)
    if kind not in FORMATS:
        raise InputError(f"{path}: the name must end in {', '.join(endings())}; other kinds are {', '.join(FORMATS)}")
    form = FORMATS[kind]
    given = {"name": name, "dtype": dtype, "parameters": parameters, "extras": list(extras), "unroll": unroll}
    asked = {key: value for key, value in given.items() if value not in (None, (), [], {})}
    refuse({f"{path}: the setting {key} is of {_taking(key)} only, not of {kind}; leave it out": key not in form.takes
            for key in asked})  # fmt: skip
    metadata = _metadata(run, h_range or _steps(run))
    described: dict[str, Any] = {"h": run.h, "box": run.box, "units": run.data.units, "metadata": metadata}
    if run.setting and form.is_c and dtype in (None, run.setting["dtype"]):
        # The tolerance of `herglotz tune` is for the dtype that tune chose.
        described |= {"dtype": run.setting["dtype"], "tolerance": run.setting["tol"]}
    described |= asked
    if "filter" in extras:
        constant = (0.0,) * len(described_parameters(run.model, parameters))
        noise = noise_of(run, constant)._asdict()
        metadata["noise"] = {key: x if isinstance(x, float) else list(x) for key, x in noise.items()}
    form.write(run.model, path, **described)
    return path


def _metadata(run: Run, h_range: tuple[float, float]) -> dict[str, Any]:
    """The entries of the run in a file's metadata."""
    (q, p, s), t = run.last_fitted()
    low, high = h_range
    return {
        "names": list(run.data.names),
        "time_unit": run.data.time_unit,
        "degrees": list(run.data.degrees),
        "start": {"q": q.tolist(), "p": p.tolist(), "s": float(s), "t": t},
        "metrics": run.metrics,
        "card": model_card(run, h_range),
        "h_range": [low * (1 - ROUNDING), high * (1 + ROUNDING)],
        **_of_inputs(run),
    }


def _taking(setting: str) -> str:
    return ", ".join(name for name, form in FORMATS.items() if setting in form.takes)


def _of_inputs(run: Run) -> dict[str, Any]:
    """How inputs arrive and, where the run has recorded inputs, their range in the training part."""
    if not run.model.inputs:
        return {}
    found: dict[str, Any] = {"arrival": run.arrival._asdict(), "columns": [*map(list, run.data.columns)]}
    if run.data.u is not None:
        parts = zip(run.data.u.split(run.data.lengths), run.train_lengths, strict=True)
        fitted = torch.cat([u[:count] for u, count in parts])
        found |= {"input_low": fitted.amin(0).tolist(), "input_high": fitted.amax(0).tolist()}
    return found


def _steps(run: Run) -> tuple[float, float]:
    """The shortest and the longest step of the fit and of the recording; a tuned model is made for one step."""
    low, high = run.h_range
    return low, high if run.setting else max(high, run.data.typical_step)
