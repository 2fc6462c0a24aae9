"""Operations that ONNX files write in a form of their own: the numbers of torch, to the last bits of float64."""

import pytest
import torch

from herglotz.codegen.trace import traced
from herglotz.errors import InputError
from herglotz.export.inline import opaque
from herglotz.export.lower.onnx import graph_of

pytest.importorskip("onnxscript")
ort = pytest.importorskip("onnxruntime")
aten = torch.ops.aten
F = torch.nn.functional
EYE = torch.eye(3, dtype=torch.float64)
NAN, INF = torch.nan, torch.inf

# A number such as 1/3 is not one of float32.
FUNCTIONS = {
    "numbers beside tensors": lambda x: (1 / 3 - x) * 0.1 + x / 7 + 0.3,
    "a number less a multiple": lambda x: torch.rsub(x, 0.1, alpha=1 / 3),
    "a number added to a multiple": lambda x: torch.add(0.1 * x, 0.3, alpha=0.7),
    "powers": lambda x: x.abs() ** 0.3 + x**3,
    "a number where a mask says so": lambda x: torch.where(x > 0.1, x, 0.1),
    "another number where a mask says so": lambda x: torch.where(x > 0.1, 0.3, x),
    "filled": lambda x: torch.full_like(x, 0.1) * x,
    "a weighted product": lambda x: torch.addcmul(x, x, x + 1, value=0.1),
    "a product taken away": lambda x: torch.addcmul(x, x, x + 1, value=-1),
    "near 0": lambda x: torch.stack([torch.expm1(1e-9 * x), torch.log1p(1e-9 * x), torch.atanh(1e-9 * x)], 1),
    "not near 0": lambda x: torch.stack([torch.expm1(x), torch.log1p(x.abs()), torch.atanh(x / 3)], 1),
    "what is no number": lambda x: torch.nan_to_num(x / 0 - 1 / x.floor(), 0.1, 0.2, 0.3),
    "what is no number, by default": lambda x: torch.nan_to_num(x / x.floor()),
    "what is finite": lambda x: torch.isfinite(x / 0) | torch.isfinite(x),
    "matrices of a sample": lambda x: (x[:, :, None] * (EYE + 0.1)) @ (x[:, None, :] * EYE) * 0.1,
    "a matrix for all samples": lambda x: 0.1 * (x @ (EYE + 0.1)),
    "a vector for all samples": lambda x: torch.mv(x, EYE[0] + 0.1)[:, None],
    "an inverse": lambda x: torch.linalg.inv_ex(x[:, :, None] * x[:, None, :] + 9 * EYE)[0],
    "a diagonal": lambda x: torch.diag_embed(x) + torch.diagonal(x[:, :, None] * EYE, 0, -2, -1)[:, None],
    "unequal parts": lambda x: torch.cat(x.split([1, 2], -1)[::-1], -1),
    "an inner axis as two": lambda x: aten.unflatten.int(x, 1, [3, 1]),
    "a function that needs no entry of ours": lambda x: torch.heaviside(x, x + 0.3),
}
# Each with its derivative, which torch writes by operations of their own.
SLOPES = {
    "tanh": torch.tanh, "sigmoid": torch.sigmoid, "log sigmoid": F.logsigmoid,
    "relu": torch.relu, "part of an axis": lambda x: x[:, 1:].sin(), "one entry": lambda x: x[:, -1:].sin(),
    "one entry without its axis": lambda x: x[:, 1].sin(), "power": lambda x: x.abs() ** 1.7,
}  # fmt: skip


class Around(torch.nn.Module):
    """A traced graph as a module."""

    def __init__(self, graph):
        super().__init__()
        self.graph = graph

    def forward(self, x):
        return self.graph(x)


def written(function, dtype=torch.float64):
    """A session of the function in ONNX, at any number of rows of three."""
    module = Around(traced(lambda x: function(x).clone(), (torch.rand(1021, 3, dtype=dtype),)))
    with torch.no_grad(), opaque(module):
        one = {0: torch.export.Dim.DYNAMIC}
        program = torch.export.export(module, (torch.rand(1021, 3, dtype=dtype),), dynamic_shapes=(one,))
    return ort.InferenceSession(graph_of(program, ("x",), ("y",), {}), providers=["CPUExecutionProvider"])


def slope_of(function):
    return lambda x: torch.func.vjp(lambda x: function(x).sum(), x)[1](torch.ones((), dtype=x.dtype))[0]


@pytest.mark.parametrize("name", [*FUNCTIONS, *(f"slope of {name}" for name in SLOPES)])
def test_an_operation_is_that_of_torch(name):
    # fails if a number of float64 passes through float32, an argument is left unread, or a sum loses what is small
    function = FUNCTIONS[name] if name in FUNCTIONS else slope_of(SLOPES[name.removeprefix("slope of ")])
    session = written(function)
    for rows in (1, 7):
        x = torch.linspace(-1.3, 1.7, 3 * rows, dtype=torch.float64).reshape(rows, 3)
        (found,) = session.run(None, {"x": x.numpy()})
        torch.testing.assert_close(torch.as_tensor(found), function(x), rtol=4e-16, atol=4e-16, equal_nan=True)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda x: torch.diag_embed(x, 1), r"does not know a diag_embed at \(1,\)"),
        (slope_of(lambda x: x[:, ::2].sin()), "does not know a slice_backward of step 2"),
        (torch.erf, "Could not find an implementation for Erf"),
        (torch.lgamma, "does not know the operation aten.lgamma.default"),
    ],
)
def test_what_is_not_written_is_refused(function, words):
    # fails if torch.onnx's own exception reaches the user, or another function is written
    with pytest.raises(InputError, match=rf"{words}.*; export to --format pt2 or c"):
        written(function)
