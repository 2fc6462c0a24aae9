"""Operations, and forms of operations, that no ONNX file of ours has: refused with what to do, not written wrongly."""

import pytest
import torch
from torch import nn
from torch.export import Dim

from herglotz.errors import InputError
from herglotz.export.lower.onnx import graph_of

pytest.importorskip("onnx")
aten = torch.ops.aten
EYE = torch.eye(3, dtype=torch.float64)
PLACE = torch.tensor([0])

FORMS = {
    "nan and infinity apart": (lambda x: torch.nan_to_num(x, 1.0, 2.0), "nan_to_num"),
    "status of an inverse": (lambda x: torch.linalg.inv_ex(x[:, :, None] * EYE)[1], "inv_ex"),
    "second output of log σ": (lambda x: aten.log_sigmoid_forward(x)[1], "log_sigmoid"),
    "repeated along a new axis": (lambda x: x.repeat(2, 1, 1), "repeat"),
    "an inner axis as two": (lambda x: aten.unflatten.int(x, 1, [3, 1]), "unflatten"),
    "product over the batch": (lambda x: torch.mv(x.transpose(0, 1), x[:, 0]), "mv"),
    "sum with a weight": (lambda x: torch.addmm(x, x, EYE, beta=2.0), "addmm"),
    "sum of a product over the batch": (lambda x: torch.addmm(EYE, x.transpose(0, 1), x), "addmm"),
    "diagonal beside the main one": (lambda x: torch.diagonal(x[:, :, None] * EYE, 1, -2, -1), "diagonal"),
    "matrix with another diagonal": (lambda x: torch.diag_embed(x, 1), "diag_embed"),
    "entries of two axes": (lambda x: x[PLACE, PLACE], "index"),
    "an operation without an entry": (torch.erf, "erf"),
}


class Applied(nn.Module):
    """A function as a module, which torch.export asks for."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, x):
        return self.function(x)


def exported(function):
    x = torch.rand(5, 3, dtype=torch.float64)
    return torch.export.export(Applied(function), (x,), dynamic_shapes=({0: Dim.DYNAMIC},))


@pytest.mark.parametrize("case", FORMS)
def test_a_form_that_is_not_written_is_refused(case):
    # fails if an argument is left unread: the file would compute another function than the model
    function, name = FORMS[case]
    with pytest.raises(InputError, match=rf"ONNX export does not know .*{name}.*; export to --format pt2 or c"):
        graph_of(exported(function), ("x",), ("y",), {})
