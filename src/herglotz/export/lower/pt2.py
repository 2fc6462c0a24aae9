"""A model as one `.pt2` file: graphs that step with PyTorch alone, or machine code (AOTInductor)."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Any

import torch
from torch.export import ExportedProgram

from herglotz.codegen.c_compiler import compiler
from herglotz.data.files import sealed_zip
from herglotz.errors import InputError
from herglotz.export.compare import compare
from herglotz.export.load import load_pt2
from herglotz.export.metadata import AOTI, KEY, METADATA, to_json
from herglotz.export.programs import programs_of, quiet, writes
from herglotz.models import ContactLagrangian
from herglotz.stepping import Stepper


@writes
def export_pt2(model: ContactLagrangian, entries: dict[str, Any]) -> bytes:
    """Write the model's flow as a `.pt2` file: graphs of tensor operations that any PyTorch of this version runs.

    The file holds five programs. `model`, which `torch.export.load(path).module()` loads on a machine without herglotz,
    is one step (q, p, s, h) → (q1, p1, s1, c, residual, status[, outside]), differentiable in the state; `rollout` is
    K steps with the loop over steps and Newton's loop inside; `linearise` is one step and its Jacobian; `init` is the
    start (q0, q1, s0, h) → (p1, s1); `legendre` is (q, v, s, h) → (L_v, L_vv). The batch size is free and every step
    h > 0 is accepted. A model with inputs takes u after h. With a box, outside is 1 where a step starts or ends outside
    the box, plus 2 where h is outside `h_range`.

    Parameters
    ----------
    model
        In float32 or float64, which becomes the dtype of the file; not changed.
    path
        The file to write, atomically; its name should end in `.pt2`.
    h
        Typical step of the model, in the data's time unit: recorded, not imposed.
    box
        The states that the model was fitted to: q_low, q_high, p_low, p_high (n numbers each), s_low, s_high (1 each),
        in the units of the model.
    units
        Unit of each coordinate.
    metadata
        Further entries, ready for JSON, under other names than those written here. With `h_range` = (low, high) the
        loaders refuse other steps, and the file flags them.
    newton_iterations
        Bound on the Newton iterations of a step, at least 2.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If h, box, units or metadata are not usable, or the file cannot be written.
    """
    with quiet():
        programs = programs_of(model, entries, ("model", "rollout", "linearise", "init", "legendre"))
        # torch.export.save calls package_pt2 for a single program.
        from torch.export.pt2_archive._package import package_pt2

        buffer = io.BytesIO()
        package_pt2(buffer, exported_programs=programs, extra_files={METADATA: to_json(entries)})
    return sealed_zip(buffer.getvalue())


@writes
def export_aoti(model: ContactLagrangian, entries: dict[str, Any]) -> bytes:
    """Compile K steps (q, p, s, h) → (q, p, s, c, residual, status[, outside]) of the model's flow to machine code.

    h has the shape (K, B), and so have the outputs (q and p: (K, B, n)); K = 1 is one step. The compiled code checks
    nothing and takes contiguous tensors of the model's dtype only; `load_pt2` adds checks. It runs on the kind of
    processor it was compiled on, without derivatives.

    The arguments, the returned path and the output `outside` are those of `export_pt2`. Raise InputError if no C++
    compiler is installed, an argument is not usable, the compiled code does not step like the model, or the file
    cannot be written.
    """
    # Imported here: the import takes seconds, which no other format needs.
    from torch._inductor.package.package import package_aoti

    settings = {"aot_inductor.metadata": {KEY: to_json(entries)}}
    compiler("CXX")
    with quiet(), torch.no_grad(), tempfile.TemporaryDirectory(prefix="herglotz-") as folder:
        package = str(Path(folder, "code.pt2"))
        programs = programs_of(model, entries, tuple(AOTI))
        package_aoti(package, {AOTI[name]: _compiled(program, settings) for name, program in programs.items()})
        content = sealed_zip(Path(package).read_bytes())
        Path(package).write_bytes(content)
        _check(package, model)
    return content


def _compiled(program: ExportedProgram, settings: dict[str, Any]) -> Any:
    """The files of one program."""
    import torch._inductor

    options = settings | {"aot_inductor.package": True}
    arguments, _ = program.example_inputs  # pyright: ignore[reportGeneralTypeIssues]
    return torch._inductor.aot_compile(program.module(check_guards=False), arguments, options=options)  # pyright: ignore


def _check(package: str, model: ContactLagrangian) -> None:
    """Compare the new file with the model: compilers have been seen to exchange values.

    Raise InputError if the file and the model disagree.
    """
    found = compare(load_pt2(package, trust_code=True), Stepper(model), batches=(1, 7), steps=20)
    # NaN where every start fails; NaN is not larger than the bound.
    worst = max(found[key] for key in ("q", "p", "s"))
    if worst > (1e-6 if next(model.parameters()).dtype == torch.float64 else 1e-2):
        raise InputError(f"the compiled code differs from the model by {worst:.1e}; export to --format c or onnx")
