"""Models as files that step on their own: `.pt2`, ONNX, machine code and C; loaded, and compared with eager."""

from herglotz.export.c_compile import compile, compile_c
from herglotz.export.c_header import export_c
from herglotz.export.compare import compare
from herglotz.export.differences import DifferencedStepper
from herglotz.export.exported import ExportedStepper
from herglotz.export.load import load_c, load_exported, load_onnx, load_pt2
from herglotz.export.lower.aoti import export_aoti
from herglotz.export.lower.onnx import export_onnx
from herglotz.export.lower.pt2 import export_pt2
from herglotz.export.metadata import weights_digest
from herglotz.export.run_file import export_run

__all__ = [
    "DifferencedStepper",
    "ExportedStepper",
    "compare",
    "compile",
    "compile_c",
    "export_aoti",
    "export_c",
    "export_onnx",
    "export_pt2",
    "export_run",
    "load_c",
    "load_exported",
    "load_onnx",
    "load_pt2",
    "weights_digest",
]
