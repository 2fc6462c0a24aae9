"""Readers of exported files: what a file can run, as functions of tensors, behind an `ExportedStepper`."""

from __future__ import annotations

import base64
import io
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data.files import PathLike, read_bytes
from herglotz.data.seal import check_seal
from herglotz.errors import InputError
from herglotz.export.exported import ExportedStepper, Program
from herglotz.export.metadata import AOTI, KEY, METADATA, from_json
from herglotz.export.programs import quiet
from herglotz.export.trusted import check_trusted


def load_pt2(path: PathLike, *, trust_code: bool = False) -> ExportedStepper:
    """Read a file that `export_pt2` or `export_aoti` wrote.

    Parameters
    ----------
    path
        The file.
    trust_code
        Open a file that was not written by this user on this machine: that runs what stands in it.

    Raises
    ------
    InputError
        If the file is missing, damaged, changed, not one of ours, of another format version, or not trusted.
    """
    content = read_bytes(path)
    check_seal(content, path)
    check_trusted(content, path, trust_code)
    try:
        with quiet():  # torch logs a traceback of its own for a damaged file; one line is enough
            if _is_compiled(content):
                return _load_aoti(path)
            from torch.export.pt2_archive._package import load_pt2 as unpack

            found = unpack(io.BytesIO(content))
            text = found.extra_files.get(METADATA)
            metadata = from_json(text.decode() if isinstance(text, bytes) else text, path)
            modules = {name: program.module(check_guards=False) for name, program in found.exported_programs.items()}
    except InputError:
        raise
    except Exception as error:  # torch raises whatever its zip, JSON and graph readers raise
        line = str(error).strip().splitlines() or [""]
        raise InputError(
            f"{path}: is not a readable .pt2 file ({type(error).__name__}: {line[0][:120]}); export the model again"
        ) from error
    return ExportedStepper(modules, metadata, str(path), "pt2")


def load_onnx(path: PathLike) -> ExportedStepper:
    """Read a file that `export_onnx` wrote; it runs on as many threads as torch does.

    Raises
    ------
    InputError
        If onnxruntime is not installed, or the file is missing, damaged, not one of ours, or of another version.
    """
    content = read_bytes(path)
    check_seal(content, path)
    try:
        import onnxruntime as ort
    except ImportError:
        raise InputError(f"{path}: needs onnxruntime; install it with: pip install onnxruntime") from None
    options = ort.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # a tenth faster for tensors of a few numbers, and no slower for others
    options.log_severity_level = 4  # an exception says it; its log line would be a second
    try:
        session = ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        entries = session.get_modelmeta().custom_metadata_map
        metadata = from_json(entries.get(KEY), path)
        programs = {"rollout": _session_program(session)}
        for name in (x for x in entries if x.startswith(f"{KEY}_")):  # further models, in base 64
            second = ort.InferenceSession(base64.b64decode(entries[name]), options, providers=["CPUExecutionProvider"])
            programs[name.removeprefix(f"{KEY}_")] = _session_program(second)
    except InputError:
        raise
    except Exception as error:  # onnxruntime has a dozen exception classes and no common one
        line = (str(error).strip().splitlines() or [""])[0]
        raise InputError(f"{path}: is not a readable .onnx file ({line[:120]}); export the model again") from None
    return ExportedStepper(programs, metadata, str(path), "onnx")


def load_exported(path: PathLike, *, trust_code: bool = False) -> Any:
    """Read any exported file, by its name: `.pt2` (also compiled), `.onnx`, or a C header `.h`.

    Parameters
    ----------
    path
        The file.
    trust_code
        As in `load_pt2`, also for a header. An ONNX file needs no trust: opening it runs nothing.

    Returns
    -------
    ExportedStepper or CompiledStepper
        Both have `step`, `rollout`, `outside_box`, `metadata`, `dof`, `dtype` and `h`.

    Raises
    ------
    InputError
        As the reader of that format.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".onnx":
        return load_onnx(path)
    if suffix == ".h":
        from herglotz.export.c_stepper import load_c

        return load_c(path, trust_code=trust_code)
    return load_pt2(path, trust_code=trust_code)


def _is_compiled(content: bytes) -> bool:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return any("/data/aotinductor/" in f"/{name}" for name in archive.namelist())


def _load_aoti(path: PathLike) -> ExportedStepper:
    from torch._inductor.package.package import load_package

    programs = {name: load_package(str(path), key) for name, key in AOTI.items()}
    loader: Any = programs["rollout"].loader
    return ExportedStepper(programs, from_json(loader.get_metadata().get(KEY), path), str(path), "aoti")


def _session_program(session: Any) -> Program:
    """An onnxruntime session as a function of tensors."""
    names = [x.name for x in session.get_inputs()]

    def run(*arguments: Tensor) -> tuple[Tensor, ...]:
        feeds = {name: x.detach().numpy() for name, x in zip(names, arguments, strict=True)}
        return tuple(torch.from_numpy(x) for x in session.run(None, feeds))

    return run
