"""Models as files that step on their own: `.pt2`, ONNX, machine code and C; loaded, and compared with eager."""

from herglotz.export.c_header import export_c as export_c
from herglotz.export.c_wrappers import (
    export_acados as export_acados,
    export_casadi as export_casadi,
    export_fmu as export_fmu,
)
from herglotz.export.compare import compare as compare
from herglotz.export.exported import ExportedStepper as ExportedStepper
from herglotz.export.filtering import Filtered as Filtered, filter as filter, noise_of as noise_of
from herglotz.export.load import (
    compile as compile,
    compile_c as compile_c,
    load_c as load_c,
    load_exported as load_exported,
    load_onnx as load_onnx,
    load_pt2 as load_pt2,
)
from herglotz.export.lower.onnx import export_onnx as export_onnx
from herglotz.export.lower.pt2 import export_aoti as export_aoti, export_pt2 as export_pt2
from herglotz.export.metadata import weights_digest as weights_digest
from herglotz.export.parameters import between as between
from herglotz.export.run_file import export_run as export_run
