"""Readers of exported files: each gives the programs of a file, as functions of tensors, to an `ExportedStepper`.

A generated header is compiled and loaded; `hz.compile` and `compile_c` do this for a model.
"""

from __future__ import annotations

import base64
import copy
import ctypes
import io
import os
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.codegen.c_compiler import build, compiler
from herglotz.data.files import TEXT_SEAL, PathLike, check_seal, check_trusted, read_bytes, refuse_weights, sealed_text
from herglotz.errors import InputError
from herglotz.export.c_header import MAX_DERIVATIVES, c_source, described, read_metadata, runtime
from herglotz.export.c_wrappers import header_in
from herglotz.export.exported import ExportedStepper, Program
from herglotz.export.metadata import AOTI, KEY, METADATA, describe, from_json, weights_digest
from herglotz.export.parameters import Chosen, checked_values, described_parameters
from herglotz.export.programs import quiet
from herglotz.export.step import MAX_ITERATIONS
from herglotz.formats import FORMATS, of_ending
from herglotz.models import ContactLagrangian, OwnLagrangian
from herglotz.stepping import Status, Stepper
from herglotz.stepping.rollout import Track

# The models that can be traced.
TRACEABLE = (ContactLagrangian, OwnLagrangian)
# Names in the archive that torch writes.
MODELS, EXTRA = "models/", f"extra/{METADATA}"


def load_exported(path: PathLike, *, trust_code: bool = False) -> ExportedStepper:
    """Read an exported file by the end of its name: `.pt2`, `.onnx`, or a file with a C header (`.h`, `.c`, `.fmu`).

    `trust_code` is as in `load_pt2`, also for a header; opening an ONNX file runs nothing and needs no trust. The
    stepper has `init`, `step`, `rollout`, `linearise`, `outside_box`, `metadata`, `dof`, `dtype` and `h`. Raise
    InputError as in the reader of that format.
    """
    refuse_weights(path)
    form = FORMATS[of_ending(Path(path).suffix) or "pt2"]
    return form.read(path, trust_code=trust_code) if form.runs_code else form.read(path)


def load_pt2(path: PathLike, *, trust_code: bool = False) -> ExportedStepper:
    """Read a file of `export_pt2` or `export_aoti`; each program of a `.pt2` file is read when it is first called.

    Parameters
    ----------
    path
        The file.
    trust_code
        Open a file that this user did not write on this machine: opening the file runs the code in it.

    Returns
    -------
    ExportedStepper
        Steps like `Stepper`; its `h`, `box` and `units` are those of the model.

    Raises
    ------
    InputError
        If the file is missing, damaged, changed, not written by herglotz, of another format version, or not trusted.
    """
    content = _sealed(path)
    check_trusted(content, path, trust_code)
    # Quiet, because torch logs a traceback for a damaged file besides the exception.
    with _reading(path, ".pt2"), quiet():
        if _is_compiled(content):
            return _load_aoti(path)
        with _archive(content) as archive:
            names = archive.get_file_names()
            metadata = from_json(archive.read_string(EXTRA) if EXTRA in names else None, path)
    programs = {Path(x).stem: _program_when_called(content, x, path) for x in names if x.startswith(MODELS)}
    return ExportedStepper(programs, metadata, str(path), "pt2")


def load_onnx(path: PathLike) -> ExportedStepper:
    """Read a file of `export_onnx`; onnxruntime gets as many threads as torch has.

    Raise InputError if onnxruntime is not installed, or the file is missing, damaged, not written by herglotz, or of
    another format version.
    """
    content = _sealed(path)
    try:
        import onnxruntime as ort
    except ImportError:
        raise InputError(f"{path}: needs onnxruntime; install it with: pip install onnxruntime") from None
    options = ort.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.inter_op_num_threads = 1
    # Without the arena, tensors of a few numbers are a tenth faster and larger ones no slower.
    options.enable_cpu_mem_arena = False
    # Fatal errors only: every error is an exception too, and a log line would repeat the exception.
    options.log_severity_level = 4
    session = lambda text: ort.InferenceSession(text, options, providers=["CPUExecutionProvider"])  # noqa: E731
    with _reading(path, ".onnx"):
        first = session(content)
        entries = first.get_modelmeta().custom_metadata_map
        metadata = from_json(entries.get(KEY), path)
        steps = _session_program(first)
        programs = {"rollout": _row_by_row(steps) if metadata.get("unrolled") else steps}
        # The metadata hold the further models in base 64.
        for name in (x for x in entries if x.startswith(f"{KEY}_")):
            programs[name.removeprefix(f"{KEY}_")] = _session_program(session(base64.b64decode(entries[name])))
    return ExportedStepper(programs, metadata, str(path), "onnx")


def load_c(path: PathLike, *, trust_code: bool = False, model: ContactLagrangian | None = None) -> ExportedStepper:
    """Compile and load a header of `export_c`, also the header in a file for CasADi or acados, or in an FMU.

    The stepper has the header's own dtype and its `metadata`. `trust_code` compiles a header that this user did not
    write on this machine: loading the header runs the code in it. A header that equals the header of `model`, the model
    of the run that the header was exported from, letter for letter needs no trust. Raise InputError if the file cannot
    be read, was changed, has no such header or is not trusted, or no compiler is installed.
    """
    content = _sealed(path, text=not _is_fmu(path))
    text = _header(content, path)
    check_trusted(content, path, trust_code or (model is not None and _is_of(text, path, model)))
    return compiled(text, path)


def read_header(path: PathLike) -> tuple[str, dict[str, Any]]:
    """The text of a header and its metadata, without compiling the header.

    Raise InputError if the file cannot be read, was changed or has no such header.
    """
    text = _header(_sealed(path, text=not _is_fmu(path)), path)
    return text, read_metadata(text, path)


def _is_fmu(path: PathLike) -> bool:
    return Path(path).suffix.lower() == ".fmu"


def _header(content: bytes, path: PathLike) -> str:
    """The header up to its own seal; code around the header is not compiled here."""
    if _is_fmu(path):
        return header_in(content, path)
    text = content.decode("utf-8", "replace").replace("\r\n", "\n")
    seal = re.search(r"^.*" + re.escape(TEXT_SEAL[0].decode()) + ".*\n", text, re.MULTILINE)
    return text[: seal.end()] if seal else text


def _sealed(path: PathLike, text: bool = False) -> bytes:
    """The content of a file; raise InputError if the file was changed since it was written."""
    content = read_bytes(path)
    check_seal(content, path, text=text)
    return content


@contextmanager
def _reading(path: PathLike, kind: str) -> Iterator[None]:
    """Turn any exception of another package's reader into an `InputError`.

    The exceptions of torch and onnxruntime have no common class.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        line = (str(error).strip().splitlines() or [""])[0][:120]
        message = f"is not a readable {kind} file ({type(error).__name__}: {line}); export the model again"
        raise InputError(f"{path}: {message}") from error


def _is_of(text: str, path: PathLike, model: ContactLagrangian) -> bool:
    """Whether the header equals the model's header with the same metadata."""
    entries = read_metadata(text, path)
    if entries.get("weights_sha256") != weights_digest(model):
        return False
    file = re.search(r'#include "([^"\n]*)"', text)
    try:
        return text == sealed_text(c_source(model, entries, file[1] if file else ""))
    except (KeyError, ValueError, TypeError, AttributeError):
        # This version would not have written such metadata.
        return False


def _is_compiled(content: bytes) -> bool:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return any("/data/aotinductor/" in f"/{name}" for name in archive.namelist())


def _archive(content: bytes) -> Any:
    from torch.export.pt2_archive._package import PT2ArchiveReader

    return PT2ArchiveReader(io.BytesIO(content))


def _program_when_called(content: bytes, name: str, path: PathLike) -> Program:
    """One program of a `.pt2` file, read at its first call: reading takes a second or more, and few uses need all."""

    @cache
    def program() -> Program:
        from torch.export.pt2_archive._package import _load_exported_programs

        with _reading(path, ".pt2"), quiet(), _archive(content) as archive:
            (found,) = _load_exported_programs(archive, [name], None).values()
            return found.module(check_guards=False)

    return lambda *arguments: program()(*arguments)


def _load_aoti(path: PathLike) -> ExportedStepper:
    from torch._inductor.package.package import load_package

    programs = {name: load_package(str(path), key) for name, key in AOTI.items()}
    loader: Any = programs["rollout"].loader
    return ExportedStepper(programs, from_json(loader.get_metadata().get(KEY), path), str(path), "aoti")


def _row_by_row(step: Program) -> Program:
    """K steps (q, p, s, h (K, B)[, u (K, B, m)]) of a program of one step."""

    def run(q: Tensor, p: Tensor, s: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
        out, state = [], (q, p, s)
        for row in zip(*rows, strict=True):
            out.append(step(*state, *(x.contiguous() for x in row)))
            state = out[-1][:3]
        return tuple(torch.stack(x) for x in zip(*out, strict=True))

    return run


def _session_program(session: Any) -> Program:
    """An onnxruntime session as a function of tensors."""
    names = [x.name for x in session.get_inputs()]

    def run(*arguments: Tensor) -> tuple[Tensor, ...]:
        feeds = {name: x.detach().numpy() for name, x in zip(names, arguments, strict=True)}
        return tuple(torch.from_numpy(x) for x in session.run(None, feeds))

    return run


def library_of(metadata: Mapping[str, Any]) -> str:
    """The C source of the loops over samples around a header with this metadata."""
    return re.sub(r"\bhz_", f"{metadata['name']}_", runtime("library.c"))


class CLibrary:
    """The compiled functions of a generated header as functions of tensors, on one thread.

    `path` is named in messages; `whole` gives the header with derivatives, where this one has none. Raise InputError if
    the text is not such a header, or no C compiler is there to compile it.
    """

    def __init__(self, header: str, path: PathLike, whole: Callable[[], str] | None = None):
        self.metadata = read_metadata(header, path)
        self.dof: int = self.metadata["dof"]
        self.inputs: int = self.metadata["inputs"]
        self.dtype: torch.dtype = getattr(torch, self.metadata["dtype"])
        self.parameters: dict[str, Any] = self.metadata.get("parameters", {})
        self.theta = torch.tensor(checked_values(self.parameters, {}), dtype=self.dtype)
        self.library = build(header, library_of(self.metadata))
        # Built on first use, once for all copies: most steppers are not differentiated.
        self.differentiates = cache(
            lambda: self.library if whole is None else build(whole(), library_of(self.metadata))
        )

    def with_values(self, values: Mapping[str, float]) -> CLibrary:
        """The library with these values of numbers that are set at run time; numbers not named have their defaults."""
        other = copy.copy(self)
        other.theta = torch.tensor(checked_values(self.parameters, values), dtype=self.dtype)
        return other

    @property
    def _theta(self) -> tuple[Tensor, ...]:
        return (self.theta,) if self.parameters else ()

    def init(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, u: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(p1, s1) at q1; NaN where the step from q0 to q1 has none."""
        states = _rows(q0, q1, s0)
        self.library.herglotz_inits(*_arguments(len(s0), h, u, *self._theta, states))
        return states[:, self.dof : -2], states[:, -2]

    def momentum(self, q: Tensor, v: Tensor, s: Tensor, h: Tensor) -> Tensor:
        """The momenta p of velocities, NaN where a velocity has no momentum."""
        states = _rows(q, v, s)
        self.differentiates().herglotz_momenta(*_arguments(len(s), h, *self._theta, states))
        return states[:, self.dof : -2]

    def velocity(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """The velocities v of momenta, NaN where a momentum has no velocity, and statuses."""
        states, v, status = _rows(q, p, s), self._empty(len(s), self.dof), self._failed(len(s))
        self.differentiates().herglotz_velocities(*_arguments(len(s), h, *self._theta, states, v, status))
        return v, status

    def linearise(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None) -> tuple[Tensor, ...]:
        """A step and its derivative (B, 2n+1, 2n+2+m+K); NaN where the step failed."""
        count, n, size = len(s), self.dof, 2 * self.dof + 1
        states, status, residual = _rows(q, p, s), self._failed(count), self._empty(count)
        by_state, by_input, by_theta, by_h = slopes = [
            self._empty(count, size, width) for width in (size, self.inputs, len(self.parameters), 1)
        ]
        written = slopes if self.parameters else (by_state, by_input, by_h)
        outputs = (states, status, residual, *written)
        self.differentiates().herglotz_jacobians(*_arguments(count, h, u, *self._theta, *outputs))
        *new, sigma = states[:, :n], states[:, n:-2], states[:, -2], states[:, -1]
        return *new, sigma, residual, status, torch.cat([by_state, by_h, by_input, by_theta], -1)

    def __call__(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None) -> Track:
        """K steps: h (B, K) and u (B, K, m) may be expanded over samples, and h over steps."""
        run, outputs = self.prepared(q, p, s, h, u)
        run()
        *states, sigma, status, residual = outputs
        return Track(tuple(states), sigma, status, residual)

    def prepared(
        self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, u: Tensor | None = None
    ) -> tuple[Callable[[], None], tuple[Tensor, ...]]:
        """A call of the rollout with its arguments already converted, and the tensors that the call writes."""
        (count, steps), n = h.shape, self.dof
        u = u if u is None or u[0].is_contiguous() else u.contiguous()
        outputs = (
            self._empty(count, steps + 1, n), self._empty(count, steps + 1, n), self._empty(count, steps + 1),
            self._empty(count, steps + 1), self._failed(count, steps), self._empty(count, steps),
        )  # fmt: skip
        u_stride = 0 if u is None else u.stride(0)
        keep = (_rows(q, p, s), h, *h.stride(), u, u_stride, *self._theta, *outputs)
        arguments = _arguments(count, steps, *keep)
        function = self.library.herglotz_rollouts
        # `keep` keeps the tensors alive as long as the call.
        return lambda keep=keep: function(*arguments), outputs  # noqa: ARG005

    def holds(
        self, states: Tensor, h: Tensor, u: Tensor, steps: int, low: Tensor, high: Tensor, out: tuple[Tensor, Tensor]
    ) -> Callable[[], None]:
        """The call that steps `states` in place, each under its input, and observes the states (`herglotz_holds`).

        States are rows (q, p, s, σ), (B, 2n+2); u is (B, m). The call writes `out`: (q, v), (B, 2n), with q between low
        and high (n,), and statuses (B,) int32 with their flags.
        """
        keep = (states, h, u, *self._theta, low, high, *out)
        arguments, function = _arguments(len(states), steps, *keep), self.differentiates().herglotz_holds
        return lambda keep=keep: function(*arguments)  # noqa: ARG005

    def _empty(self, *shape: int) -> Tensor:
        return torch.full(shape, torch.nan, dtype=self.dtype)

    def _failed(self, *shape: int) -> Tensor:
        return torch.full(shape, int(Status.DIVERGED), dtype=torch.uint8)


def _rows(q: Tensor, p: Tensor, s: Tensor) -> Tensor:
    """States of C as rows (q, p, s, σ), (B, 2n + 2), with σ = 1."""
    return torch.cat([q, p, s[:, None], torch.ones_like(s)[:, None]], 1)


def _arguments(*values: Tensor | int | None) -> list[Any]:
    """Numbers and addresses of tensors as arguments of a C function."""
    return [
        ctypes.c_long(x) if isinstance(x, int) else ctypes.c_void_p(None if x is None else x.data_ptr()) for x in values
    ]


def compiled(header: str, path: PathLike = "header", whole: Callable[[], str] | None = None) -> ExportedStepper:
    """The stepper of a header; arguments and errors are those of `CLibrary`."""
    return stepper_of(CLibrary(header, path, whole), str(path), whole is not None or "_VELOCITIES" in header)


def stepper_of(library: CLibrary, path: str, velocities: bool) -> ExportedStepper:
    """The stepper of a compiled header."""
    programs: dict[str, Any] = {"init": library.init}
    if library.dof <= MAX_DERIVATIVES:
        programs["linearise"] = library.linearise
    if velocities:
        programs |= {"momentum": library.momentum, "velocity": library.velocity}
    again = lambda values: stepper_of(library.with_values(values), path, velocities)  # noqa: E731
    return ExportedStepper(programs, library.metadata, path, "c", library, again)


def compile(
    source: Stepper | ContactLagrangian | PathLike | Any, *, trust_code: bool = False
) -> ExportedStepper | Stepper:
    """A stepper with the interface of `Stepper` that steps in C, without derivatives.

    The library is kept in ~/.cache/herglotz/c by the hash of the model. Without a C compiler, or for a model that has
    no C, the result is the eager stepper, and a warning says what is missing.

    Parameters
    ----------
    source
        A model, a `Stepper` of one, a run (its h, box and units are recorded), or a header that `export_c` wrote.
    trust_code
        As in `load_c`, for a header.

    Returns
    -------
    ExportedStepper or Stepper
        The eager stepper where C is not possible.

    Raises
    ------
    InputError
        If the source is none of these, or a header cannot be compiled: a header has no eager stepper to fall back on.
    """
    if isinstance(source, str | os.PathLike):
        return load_c(source, trust_code=trust_code)
    eager = source if isinstance(source, Stepper) else None
    # A run has its model as an attribute.
    run: Any = source
    own = source if isinstance(source, TRACEABLE) else getattr(source, "model", None)
    model: Any = own if eager is None else eager.L_d
    if not isinstance(model, TRACEABLE):
        if eager is None:
            given = type(source).__name__
            raise InputError(f"compile needs a model, a Stepper, a run or the path of a C header, got {given}")
        return _fall_back(eager, f"{type(model).__name__} is no ContactLagrangian and has no C form")
    of_run: dict[str, Any] = {} if eager or model is run else {"h": run.h, "box": run.box, "units": run.data.units}
    eager = eager or Stepper(model)
    if eager.throw:
        return _fall_back(eager, "throw=True needs the eager stepper")
    try:
        compiler()
        return compile_c(model, **of_run)
    except InputError as error:
        return _fall_back(eager, str(error))


def _fall_back(eager: Stepper, reason: str) -> Stepper:
    warnings.warn(f"hz.compile: stepping in PyTorch instead of C: {reason}", RuntimeWarning, stacklevel=3)
    return eager


def compile_c(
    model: Any,
    *,
    h: float = 1.0,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    dtype: str | None = None,
    tolerance: float | None = None,
    parameters: Chosen = (),
) -> ExportedStepper:
    """Compile a model's C and load it; `load_c` compiles a header.

    The library is kept in ~/.cache/herglotz/c (or $XDG_CACHE_HOME) by the hash of its source, the compiler and the
    processor. The compiler is $CC, or cc, gcc or clang from the PATH.

    The model, a ContactLagrangian or OwnLagrangian, is not changed. The other arguments are those of `export_c`; dtype
    defaults to the model's. The result is a drop-in for `Stepper`, and its `with_parameters` sets parameters. Raise
    InputError if no compiler is installed, or an argument is not usable.
    """
    given: object = model
    if not isinstance(given, TRACEABLE):
        raise InputError(f"compile_c takes a model, got {type(given).__name__}; load_c opens a header")
    dtype = dtype or str(next(model.parameters()).dtype).removeprefix("torch.")
    extra = {"parameters": described_parameters(model, parameters)} if parameters else {}
    entries = describe(model, h, box, units, MAX_ITERATIONS, {"h_range": None, **extra})
    entries = described(model, entries, "model", dtype, tolerance)
    # A copy, because training may change the model before `whole` is called.
    kept: Any = copy.deepcopy(model)
    header = c_source(kept, entries, "stepper.h", derivatives=False)
    return compiled(header, "compiled model", lambda: c_source(kept, entries, "stepper.h"))
