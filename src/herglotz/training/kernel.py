"""The compiled kernel of a fit: the step of a model with its derivatives by state and parameters, traced to C.

The parameters θ are an argument of the kernel, and so are the rates of waves (`rates`). One library therefore serves
every fit of a structure and every subset of its terms: an absent term has the coefficient 0. The library is cached on
disk under the hash of the configuration, the sources of this package, the compiler and the processor.

Large networks, order 4 of several coordinates, and machines without a compiler have no kernel: `kernel_of` returns
None, and torch evaluates the same functions.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import vmap

import herglotz
from herglotz.codegen.angles import Angles
from herglotz.codegen.c_compiler import SOURCE, built, compiler
from herglotz.codegen.gated import Prepared, gated
from herglotz.codegen.interpret import interpret
from herglotz.codegen.program import Outputs, Program
from herglotz.codegen.trace import traced
from herglotz.errors import InputError
from herglotz.mechanics import momentum_plus, momentum_residual, step_derivative
from herglotz.models import ContactLagrangian, ModelConfig, numbers_of
from herglotz.models.features import expand
from herglotz.stepping.equation import PartialsEquation
from herglotz.stepping.newton import StickSlip, at_rest
from herglotz.stepping.state import State
from herglotz.training.dictionary import dictionary, keys_of
from herglotz.training.parameter_vector import FixedModel, ParameterVector
from herglotz.training.rates import Base, buffers_at, rates_of, terms_of

RUNTIME = Path(herglotz.__file__).parent / "codegen" / "runtime"
# Largest number of parameters of a kernel. Three joints with all their terms have 206, which gcc compiles in 5 s.
MAX_PARAMETERS = 300
# Long straight-line code gains nothing from -O3, which takes 13 times as long, but much from fused multiply-adds,
# which gcc leaves out at -O1.
COMPILER_FLAGS = ("-O1", "-fexpensive-optimizations")
# Packages, and files of `training`, whose sources decide what a kernel computes.
SOURCE_PACKAGES = ("models", "mechanics", "stepping", "codegen")
SOURCE_FILES = ("kernel.py", "parameter_vector.py", "rates.py")
# Arguments of the C functions that `hz_prepare` sets.
PREPARED_ARGUMENTS = ("const char *restrict gate", "const double *restrict fixed")


class Placed(NamedTuple):
    """A kernel and the places of a model's free parameters in its θ; `rest` is θ with 0 at these places.

    `constants` are the least widths of smooth friction, and the rates of waves.
    """

    kernel: Kernel
    chosen: Tensor  # (P,)
    rest: Tensor  # (Pk,) of the kernel
    constants: Tensor  # (n + R,)


def kernel_of(model: ContactLagrangian, parameters: ParameterVector | None = None) -> Placed | None:
    """The kernel that evaluates a model, compiled unless cached; None if the model can have none.

    `parameters` are the free parameters of a fit, by default all. The others keep their values in the model.
    """
    if not isinstance(model, ContactLagrangian):
        return None
    c, config = model.capabilities, model.config
    plain = not config.terms and (c.order == 2 or model.dof == 1)
    like = next(model.parameters())
    if not plain or like.device.type != "cpu" or like.dtype != torch.float64:
        return None
    try:
        compiler()
    except InputError:
        return None
    if (found := _places(config)) is None:
        return None
    kernel, place, rates = found
    rest = torch.zeros(len(kernel.numbers), dtype=torch.float64)
    numbers = list(place)
    if parameters is not None and len(parameters.numbers) < len(numbers):
        rest[torch.tensor(list(place.values()))] = ParameterVector(model).get()
        numbers = parameters.numbers
    chosen = torch.tensor([place[name] for name in numbers], dtype=torch.long)
    rest[chosen] = 0.0
    sharpest = dict(model.named_buffers()).get("friction.sharpest", rest.new_zeros(model.dof))
    return Placed(kernel, chosen, rest, torch.cat([sharpest, rates]))


@lru_cache(maxsize=256)
def _places(config: ModelConfig) -> tuple[Kernel, dict[str, int], Tensor] | None:
    """The kernel of a configuration, the place of each number of the model in θ, and the rates of waves (R,)."""
    rates = rates_of(terms_of(config))
    features, drag = rates.standard(expand(config.features, config.angles)), rates.standard(config.drag)
    kernel = _kernel(_whole(replace(config, features=features, drag=drag)))
    if kernel is None:
        return None
    numbers = ParameterVector(ContactLagrangian(config)).numbers
    keys = (rates.texts.get(key, key) for key in keys_of(numbers, config))
    place = {name: kernel.place[key] for name, key in zip(numbers, keys, strict=True)}
    return kernel, place, kernel.rates(rates.values)


def structure(config: ModelConfig) -> ModelConfig:
    """The configuration with defaults for all that a kernel has as an argument: starts, sizes, and absent numbers.

    The sizes of the inputs of a network are constants of the kernel, and stay.
    """
    plain = replace(config, seed=0, absent=())
    plain = plain if config.level in ("affine", "full") else replace(plain, damping_width=0)
    if config.networks:
        return plain
    n = len(config.angles)
    ones, zeros = (1.0,) * n, (0.0,) * n
    # With a shared mass or translations, the potential of the baseline is a constant and no argument.
    constant = config.alike or config.translations
    stiffness, tilt = (config.stiffness, config.tilt) if constant else (ones, zeros)
    return replace(plain, scale=ones, speed=ones, stiffness=stiffness, tilt=tilt, rate=0.1)


@cache
def _whole(config: ModelConfig) -> ModelConfig:
    """The dictionary that contains a model; the structure of the model itself if no small dictionary does."""
    whole = dictionary(config)
    small = whole is not None and len(numbers_of(ContactLagrangian(whole))) <= MAX_PARAMETERS
    return whole if whole is not None and small else structure(config)


@cache
def _kernel(config: ModelConfig) -> Kernel | None:
    """The kernel of this structure; None if it has too many parameters or an operation that C does not have."""
    model = ContactLagrangian(config)
    if len(numbers_of(model)) > MAX_PARAMETERS:
        return None
    with suppress(InputError):
        return Kernel(model)
    return None


@cache
def _sources() -> str:
    """The hash of the package's sources that decide what a kernel computes, and the version of torch."""
    root, digest = Path(herglotz.__file__).parent, hashlib.sha256()
    for name in SOURCE_FILES:
        digest.update((root / "training" / name).read_bytes())
    for package in SOURCE_PACKAGES:
        for path in sorted((root / package).rglob("*")):
            if path.suffix in (".py", ".c", ".h"):
                digest.update(path.read_bytes())
    return digest.hexdigest() + torch.__version__


class Kernel:
    """Free runs of a structure over segments, with derivatives by the start state and by chosen parameters."""

    def __init__(self, model: ContactLagrangian):
        self.n, self.m, self.sticks = model.dof, model.inputs, model.capabilities.sticking
        self.d = states_of(model)
        # Names of the entries of θ, in order.
        self.numbers = ParameterVector(model).numbers
        self.place = {key: i for i, key in enumerate(keys_of(self.numbers, model.config))}
        self.bases = list(rates_of(terms_of(model.config)).values)
        key = _sources() + OPTIMISED + json.dumps(model.config.to_dict(), sort_keys=True)
        self.library = built(key, lambda: {SOURCE: source_of(model)}, COMPILER_FLAGS)
        self.library.hz_sweep.restype = ctypes.c_long
        self.library.hz_eliminate.restype = ctypes.c_long

    def rates(self, values: Mapping[Base, float]) -> Tensor:
        """The rates of waves (R,) as arguments, from those of a model; the waves of the others are absent."""
        return torch.tensor([values.get(base, base.standard) for base in self.bases], dtype=torch.float64)

    def sweep(self, *arguments: Any) -> int:
        """`hz_sweep` of `codegen/runtime/sweep.c`: -1, or the index of the segment with a step without solution."""
        return self.library.hz_sweep(*map(_passed, arguments))

    def eliminate(self, diagonal: Tensor, upper: Tensor, columns: Tensor) -> Tensor | None:
        """The solution (S, d, R) of a block tridiagonal system; None if the matrix is not positive definite."""
        x, work = columns.contiguous().clone(), torch.empty_like(upper)
        S, d, R = x.shape
        bad = self.library.hz_eliminate(*map(_passed, (S, d, R, diagonal.contiguous(), upper.contiguous(), x, work)))
        return x if bad < 0 else None


def _passed(x: Tensor | float | int | None) -> Any:
    """A number, or the address of a tensor, as a C argument."""
    if isinstance(x, int):
        return ctypes.c_long(x)
    if isinstance(x, float):
        return ctypes.c_double(x)
    assert x is None or x.is_contiguous()
    return ctypes.c_void_p(None if x is None else x.data_ptr())


def states_of(model: ContactLagrangian) -> int:
    """d, the size of the state that the motion depends on: 2n for (q, p), or 2n + 1 if s enters the motion."""
    return 2 * model.dof + model.s_enters_motion


class Functions:
    """The functions that the C runtime calls, as tensor code to be traced.

    x = (q, p, s) is (B, 2n + 1). θ (P,) and `constants` (n + R,), the least widths of smooth friction and the rates of
    waves, have no batch.
    """

    def __init__(self, model: ContactLagrangian):
        self.parameters, self.n, self.sticks = ParameterVector(model), model.dof, model.capabilities.sticking
        self.d, self.bases = states_of(model), list(rates_of(terms_of(model.config)).values)

    def equation(self, x: Tensor, h: Tensor, u: Tensor | None, theta: Tensor, constants: Tensor) -> PartialsEquation:
        """The step equation in Δ, with second derivatives."""
        n, model = self.n, self.parameters.model
        sharpest, rates = constants.split([n, len(constants) - n])
        buffers = buffers_at(model, self.bases, rates)
        if "friction.sharpest" in dict(model.named_buffers()):
            buffers["friction.sharpest"] = sharpest
        at = FixedModel(self.parameters, theta, u, buffers)
        state = State(x[:, :n], x[:, n : 2 * n], x[:, 2 * n])
        return PartialsEquation(at, state, h, 2, increments=True)  # pyright: ignore[reportArgumentType]

    def rest(self, x: Tensor, h: Tensor, u: Tensor | None, theta: Tensor, constants: Tensor) -> tuple[Tensor, ...]:
        """z, K and w/K with which the iteration for set-valued friction starts (`herglotz.stepping.newton`)."""
        return tuple(y.clone() for y in at_rest(self.equation(x, h, u, theta, constants)))

    def evaluate(
        self, x: Tensor, z: Tensor, h: Tensor, u: Tensor | None, theta: Tensor, constants: Tensor, *held: Tensor
    ) -> tuple[Tensor, ...]:
        """F and J at the increment Δ = z; with set-valued friction at the z of `herglotz.stepping.newton`."""
        equation: Any = self.equation(x, h, u, theta, constants)
        point = (StickSlip(equation, *held) if held else equation)(z, True)
        return point.F.clone(), point.J.clone()

    def derive(
        self, x: Tensor, delta: Tensor, h: Tensor, u: Tensor | None, theta: Tensor, constants: Tensor
    ) -> tuple[Tensor, ...]:
        """F, J, (p1, s1 − s0), ∂(q1, p1)/∂(q, p), c and ∂(F, p1)/∂θ at the increment Δ of a solved step.

        If s enters the motion, the derivatives are those of (q1, p1, s1) by (q, p, s), and of (F, p1, s1) by θ.
        """
        n, d, p0 = self.n, self.d, x[:, self.n : 2 * self.n]

        def of_sample(theta: Tensor, x: Tensor, delta: Tensor, h: Tensor, u: Tensor | None) -> Tensor:
            driven = None if u is None else u[None]
            P = self.equation(x[None], h[None], driven, theta, constants)(delta[None], False).rest
            return torch.cat([momentum_residual(P, x[None, n : 2 * n]), momentum_plus(P), P.L[:, None]], -1)[0, :d]

        # Autograd by a copy of θ for each sample: `torch.func.vjp` would import torch's compiler, which takes longer
        # than the trace.
        with torch.enable_grad():
            own = theta.expand(len(x), -1).clone().requires_grad_()
            results = vmap(of_sample, (0, 0, 0, 0, None if u is None else 0))(own, x, delta, h, u).unbind(-1)
            G = torch.stack([torch.autograd.grad(r.sum(), own, retain_graph=True)[0] for r in results], 1)
        point = self.equation(x, h, u, theta, constants)(delta, True)
        P, J = point.rest, point.J
        assert J is not None
        end = torch.cat([momentum_plus(P), P.L[:, None]], -1)
        A, c = step_derivative(P, p0)[:, :d, :d], P.c.expand(len(x))
        return tuple(y.clone() for y in (point.F, J, end, A, c, G))


@torch.inference_mode(mode=False)
def source_of(model: ContactLagrangian) -> str:
    """The C source of a structure: sizes, traced functions, and the runtime."""
    functions, prepared = Functions(model), Prepared()
    n, m, P, sticks = functions.n, model.inputs, len(functions.parameters.numbers), functions.sticks
    end = {"h": 0, **({"u": m} if m else {}), "theta": P, "constants": n + len(functions.bases)}
    held = {"stiffness": n, "bound": n} if sticks else {}
    state, solved = {"x": 2 * n + 1}, ("F", "J", "end", "A", "*c", "G")
    parts = []
    if sticks:
        rest = _Traced(functions.rest, state | end, m, ("z", "stiffness", "bound"), prepared)
        trial = _Traced(functions.evaluate, state | {"z": n} | end | held, m, ("F", "J"), prepared)
        parts = [rest.function("rest", "z", "stiffness", "bound"), trial.function("evaluate", "F", "J")]
    step = _Traced(functions.derive, state | {"delta": n} | end, m, solved, prepared)
    parts += [] if sticks else [step.function("evaluate", "F", "J")]
    parts += [step.function("finish", "end"), step.function("derive", "end", "A", "*c", "G")]
    values = {"N": n, "M": m, "P": P, "D": functions.d, "STICKS": int(sticks)}
    sizes = "".join(f"#define hz_{name} {value}\n" for name, value in values.items())
    names = ("mathematics.h", "inverse.h", "sweep.c", "tridiagonal.c")
    head, inverse, *loops = ((RUNTIME / name).read_text() for name in names)
    return "\n".join([sizes, head, inverse, *parts, prepared.function(), OPTIMISED, *loops])


OPTIMISED = """
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("O3")
#endif
"""


class _Traced:
    """A traced function, from which C functions that compute some of its results are written."""

    def __init__(
        self,
        function: Callable[..., Any],
        given: dict[str, int],
        inputs: int,
        results: Sequence[str],
        prepared: Prepared,
    ):
        self.program, self.given, self.inputs, self.prepared = Program(loop=math.inf), given, inputs, prepared
        self.program.angles = Angles(self.program)
        at = list(given).index("h") + 1
        whole_function = function if inputs else lambda *x: function(*x[:at], None, *x[at:])
        graph = traced(whole_function, _examples(given))
        arrays = interpret(self.program, graph, [self.program.given(key, size) for key, size in given.items()])
        self.outputs = {
            name: array.ravel()[0] if name.startswith("*") else list(array.ravel())
            for name, array in zip(results, arrays, strict=True)
        }

    def function(self, name: str, *results: str) -> str:
        """The C function hz_`name` that writes these results."""
        written = [f"double {key if key.startswith('*') else f'*restrict {key}'}" for key in results]
        read = [f"double {key}" if size == 0 else f"const double *restrict {key}" for key, size in self.given.items()]
        if not self.inputs:
            read.insert(list(self.given).index("h") + 1, "const double *restrict u")
        outputs: Outputs = {key: self.outputs[key] for key in results}
        head = f"\nstatic void hz_{name}({', '.join([*read, *PREPARED_ARGUMENTS, *written])})"
        # G are derivatives by θ, and has a column for each parameter.
        columns = {"G": self.given["theta"]}
        return gated(self.program, head, outputs, self.prepared, columns)


def _examples(given: dict[str, int]) -> tuple[Tensor, ...]:
    """Example arguments of these sizes for a trace of one sample, because a kernel steps one.

    θ and `constants` have no batch, and a size of 0 is a scalar.
    """
    make = torch.Generator().manual_seed(0)
    found = []
    for name, size in given.items():
        batch = [] if name in ("theta", "constants") else [1]
        shape = [*batch, size] if size else batch
        found.append(0.1 + torch.rand(shape, generator=make, dtype=torch.float64) / 10)
    return tuple(found)
