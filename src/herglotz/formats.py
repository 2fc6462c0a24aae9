"""The formats of exported files: how the name of such a file ends, what writes it, what reads it, what it is for.

A further format is one module in `herglotz.export` and one line in `FORMATS`. The table names functions as text
(`module:function` of `herglotz.export`), so that the help of the command line does not import PyTorch.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

# Settings of `export_run` that every file with C takes.
OF_C = ("name", "dtype")


class Format(NamedTuple):
    """One line of `FORMATS`.

    `writer` is called as writer(model, path, h=, box=, units=, metadata=, **settings) with those of the settings in
    `takes` that the user gives, and returns the path; `reader` as reader(path), or as reader(path, trust_code=) if
    opening the file `runs_code`, and returns an `ExportedStepper`.
    """

    ending: str
    writer: str
    reader: str
    words: str
    takes: tuple[str, ...] = ()
    runs_code: bool = True

    @property
    def is_c(self) -> bool:
        """Whether the file holds a C header."""
        return "dtype" in self.takes

    @property
    def write(self) -> Callable[..., Any]:
        """The function that writes the file."""
        return _named(self.writer)

    @property
    def read(self) -> Callable[..., Any]:
        """The function that reads the file."""
        return _named(self.reader)


# Of several formats with one ending, the first is meant where the ending alone is given.
FORMATS = {
    "pt2": Format(
        ".pt2",
        "lower.pt2:export_pt2",
        "load:load_pt2",
        "graphs of PyTorch operations: one differentiable step, K steps, and a start from two positions. Any batch "
        "size, any step; torch.export.load(FILE).module() needs no herglotz",
    ),
    "aoti": Format(
        ".pt2",
        "lower.pt2:export_aoti",
        "load:load_pt2",
        "K steps and a start compiled to machine code (needs g++ or clang++, one or two minutes): fast batches",
    ),
    "onnx": Format(
        ".onnx",
        "lower.onnx:export_onnx",
        "load:load_onnx",
        "K steps (q, p, s, h) for onnxruntime and numpy, without PyTorch; a start from two positions in its metadata",
        ("unroll",),
        runs_code=False,
    ),
    "c": Format(
        ".h",
        "c_header:export_c",
        "load:load_c",
        "one C99 header that steps with <math.h> alone: the fastest single steps",
        (*OF_C, "parameters", "extras"),
    ),
    "casadi": Format(
        ".c",
        "c_wrappers:export_casadi",
        "load:load_c",
        "one C file for casadi.external: step and Jacobian",
        OF_C,
    ),
    "acados": Format(
        ".c",
        "c_wrappers:export_acados",
        "load:load_c",
        "one C file for acados' discrete dynamics: step and Jacobian",
        OF_C,
    ),
    "fmu": Format(
        ".fmu",
        "c_wrappers:export_fmu",
        "load:load_c",
        "an FMU for co-simulation, FMI 3.0, with C sources and a binary for this machine",
        OF_C,
    ),
    "fmu2": Format(".fmu", "c_wrappers:export_fmu2", "load:load_c", "the same for FMI 2.0", OF_C),
}


def of_ending(ending: str) -> str | None:
    """The first format whose files end so, such as "onnx" for ".onnx"; None if no format has this ending."""
    return next((name for name, one in FORMATS.items() if one.ending == ending.lower()), None)


def endings() -> tuple[str, ...]:
    """The endings of all formats, each once, in the order of the table."""
    return tuple(dict.fromkeys(one.ending for one in FORMATS.values()))


def _named(text: str) -> Callable[..., Any]:
    module, _, name = text.partition(":")
    return getattr(import_module(f"herglotz.export.{module}"), name)
