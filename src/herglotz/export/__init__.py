"""Models as files that step on their own: `.pt2` written, loaded and compared with the eager stepper."""

from herglotz.export.compare import compare
from herglotz.export.loader import ExportedStepper, load_pt2
from herglotz.export.module import StepModule
from herglotz.export.pt2 import export_pt2, weights_digest

__all__ = ["ExportedStepper", "StepModule", "compare", "export_pt2", "load_pt2", "weights_digest"]
