"""Models as files that step on their own: `.pt2` and C headers, loaded and compared with the eager stepper."""

from herglotz.export.c_header import export_c
from herglotz.export.c_stepper import CompiledStepper, compile_c
from herglotz.export.compare import compare
from herglotz.export.loader import ExportedStepper, load_pt2
from herglotz.export.module import StepModule
from herglotz.export.pt2 import export_pt2, weights_digest

__all__ = [
    "CompiledStepper",
    "ExportedStepper",
    "StepModule",
    "compare",
    "compile_c",
    "export_c",
    "export_pt2",
    "load_pt2",
    "weights_digest",
]
