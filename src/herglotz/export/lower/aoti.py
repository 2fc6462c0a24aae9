"""A model as machine code in a `.pt2` file (AOTInductor): fast batches without Python, on one kind of processor."""

from __future__ import annotations

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
from herglotz.export.metadata import AOTI, KEY, to_json
from herglotz.export.programs import programs_of, quiet, writes
from herglotz.models import ContactLagrangian
from herglotz.stepping import Stepper


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
