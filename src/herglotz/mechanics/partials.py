"""Derivatives of a discrete contact Lagrangian, through one door; and of functions of (q, x, s).

A discrete Lagrangian is any callable `L_d(q0, q1, s0, h) -> (...)`. If L_d has a method
`partials(q0, q1, s0, h, order)`, as every learnable model has, the method supplies the derivatives; otherwise autograd
does. No other module calls autograd on a Lagrangian.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from inspect import signature
from typing import Any, Protocol, cast, runtime_checkable

import torch
from torch import Tensor
from torch.func import vjp

from herglotz.errors import InputError
from herglotz.mechanics.contact import normal, rows_of, split


class DiscreteLagrangian(Protocol):
    """L_d(q0, q1, s0, h): the increment of the action variable s over one step."""

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, /) -> Tensor:
        """Return L_d, shape (...)."""
        ...


@runtime_checkable
class Forced(Protocol):
    """A discrete Lagrangian that comes with discrete forces F⁻ and F⁺ (Lagrange–d'Alembert–Herglotz)."""

    def forces(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, /) -> tuple[Tensor, Tensor] | None:
        """Return F⁻ and F⁺, each (..., n); None where this model has none."""
        ...


@runtime_checkable
class Driven(Protocol):
    """A family of discrete Lagrangians L_d^k, one for each input u_k, such as a motor's torque in step k."""

    def at(self, u: Tensor, /) -> DiscreteLagrangian:
        """The discrete Lagrangian of a step whose input is u, (..., m)."""
        ...


@runtime_checkable
class ClosedForm(Protocol):
    """A discrete Lagrangian that knows its own derivatives."""

    def partials(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 1) -> Partials:
        """Return the value and the derivatives up to `order`."""
        ...


# A derivative that was not asked for is None, which fails at first use.
ABSENT: Tensor = cast(Tensor, None)


@dataclass(frozen=True)
class Forces:
    """Discrete forces at (q0, q1, s0), in units of momentum; derivatives only when order 2 was asked for.

    Forces change the momenta, p_k = −(D1 + F⁻)/c and p_{k+1} = D2 + F⁺ (trap 4 of `docs/mathematics.md`), not the
    action.
    """

    minus: Tensor  # (..., n) F⁻
    plus: Tensor  # (..., n) F⁺
    minus_1: Tensor = ABSENT  # (..., n, n) [i, j] = ∂F⁻_i/∂q0_j
    minus_2: Tensor = ABSENT  # (..., n, n) ∂F⁻/∂q1
    minus_3: Tensor = ABSENT  # (..., n) ∂F⁻/∂s0
    plus_1: Tensor = ABSENT  # (..., n, n) ∂F⁺/∂q0
    plus_2: Tensor = ABSENT  # (..., n, n) ∂F⁺/∂q1
    plus_3: Tensor = ABSENT  # (..., n) ∂F⁺/∂s0
    # The largest impulse of dry friction on a coordinate at rest (q1 = q0), where F⁻ is any value between minus − held
    # and minus + held; 0 where the coordinate slides. None: no friction is set-valued.
    held: Tensor | None = None  # (..., n)
    grip: Tensor | None = None  # (..., n) size of dry friction's part of F⁻, of coordinates that slide too

    def weighted(self, P: Partials) -> Forces:
        """Return these forces with (1 + D3) F⁻ in place of F⁻, the weight of order 2 where c depends on s."""
        minus, c = self.minus, P.c[..., None]
        if P.D11 is ABSENT:
            return replace(self, minus=c * minus)
        product = lambda dF, dc: c[..., None] * dF + minus[..., :, None] * dc[..., None, :]  # noqa: E731
        return replace(
            self, minus=c * minus, minus_1=product(self.minus_1, P.D13), minus_2=product(self.minus_2, P.D23),
            minus_3=c * self.minus_3 + minus * P.D33[..., None],
        )  # fmt: skip


@dataclass(frozen=True)
class Partials:
    """Value and partial derivatives of L_d at (q0, q1, s0), and its forces; second derivatives only at order 2."""

    L: Tensor  # (...)
    D1: Tensor  # (..., n)    ∂L/∂q0
    D2: Tensor  # (..., n)    ∂L/∂q1
    D3: Tensor  # (...)       ∂L/∂s0
    D11: Tensor = ABSENT  # (..., n, n)
    D12: Tensor = ABSENT  # (..., n, n) [i, j] = ∂²L/∂q0_i ∂q1_j
    D22: Tensor = ABSENT  # (..., n, n)
    D13: Tensor = ABSENT  # (..., n)
    D23: Tensor = ABSENT  # (..., n)
    D33: Tensor = ABSENT  # (...)
    force: Forces | None = None

    @property
    def c(self) -> Tensor:
        """One-step conformal factor c = 1 + D3, shape (...)."""
        return 1.0 + self.D3

    def map(self, change: Callable[[Tensor], Tensor]) -> Partials:
        """Return the record with `change` applied to every tensor, those of the forces included."""
        return _map(self, change)


def _map(record: Any, change: Callable[[Tensor], Tensor]) -> Any:
    present = {name: value for name, value in vars(record).items() if value is not None}
    return type(record)(**{k: _map(x, change) if isinstance(x, Forces) else change(x) for k, x in present.items()})


def partials(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n) position
    q1: Tensor,  # (..., n) next position
    s0: Tensor,  # (...) action variable
    h: Tensor | float,  # () or (...) time step
    order: int = 1,
) -> Partials:
    """Value, gradient (D1, D2, D3 L_d) and, at order 2, Hessian blocks of L_d.

    p0 = −D1 L_d / (1 + D3 L_d) and p1 = D2 L_d follow (section 1 of `docs/mathematics.md`). The derivatives come from
    the `partials` method of L_d, or from autograd without such a method. Both are differentiable again with respect to
    the arguments and the parameters.

    Parameters
    ----------
    L_d
        The discrete Lagrangian L_d(q0, q1, s0, h), which returns (...) numbers in units of action.
    q0, q1
        (..., n) position and next position, in the units of L_d.
    s0
        (...) action variable, in the unit of L_d.
    h
        () or (...) time step, in the unit of time.
    order
        1, or 2 for second derivatives too.

    Returns
    -------
    Partials
        D1 and D2 (..., n), D3 (...), and blocks such as D12 (..., n, n), in units of action over the units of
        the arguments; second derivatives are None at order 1.

    Raises
    ------
    ValueError
        If `order` is neither 1 nor 2.
    InputError
        If an argument has the wrong type or shape, or L_d does not return one number for every sample.
    """
    if order not in (1, 2):
        raise ValueError(f"order must be 1 or 2, got {order}")
    check_arguments(q0, q1, s0)
    h = torch.as_tensor(h, dtype=q0.dtype, device=q0.device)
    if isinstance(L_d, ClosedForm):
        return L_d.partials(q0, q1, s0, h, order)
    check_function(L_d)
    return autograd_partials(L_d, q0, q1, s0, h, order)


def check_function(L_d: Any, name: str = "L_d") -> None:
    """Raise InputError if L_d is no function of tensors: an object, or a class in place of a module of that class."""
    what = f"{name} must be a module or function"
    if isinstance(L_d, type):
        raise InputError(f"{what}, got the class {L_d.__name__}; make one: {L_d.__name__}()")
    if not callable(L_d):
        raise InputError(f"{what} L_d(q0, q1, s0, h), got a {type(L_d).__name__}; of a Stepper, give its L_d")


def value(L_d: DiscreteLagrangian, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor | float) -> Tensor:
    """L_d(q0, q1, s0, h), shape (...), with the checks of `partials` and no derivatives."""
    check_arguments(q0, q1, s0)
    h = torch.as_tensor(h, dtype=q0.dtype, device=q0.device)
    a, b, s, _ = torch.broadcast_tensors(q0, q1, s0[..., None], h[..., None])
    L = checked(L_d, called(L_d, q0, q1, s0, h), s[..., 0])
    if h.ndim:
        _check_alone(L_d, L, a, b, s[..., 0], h)
    return L


def in_vmap(x: Tensor) -> bool:
    """Whether a tensor is one sample of many inside `torch.func.vmap`, where its numbers cannot be asked for."""
    functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    while functorch.is_functorch_wrapped_tensor(x) and not functorch.is_batchedtensor(x):
        x = functorch.get_unwrapped(x)
    return functorch.is_batchedtensor(x)


def check_tensors(**arguments: Any) -> None:
    """Raise InputError for the first argument that is no tensor."""
    for name, x in arguments.items():
        if not isinstance(x, Tensor):
            remedy = "give its parts with a star, as in (*state, h=h)" if isinstance(x, tuple) else REMEDY
            raise InputError(f"{name} must be a tensor, got a {type(x).__name__}; {remedy}")


def check_positions(**positions: Any) -> None:
    """Raise InputError for the first argument that is no tensor (..., n) of coordinates."""
    check_tensors(**positions)
    for name, x in positions.items():
        if x.ndim == 0 or not x.shape[-1]:
            raise InputError(f"{name} needs shape (..., n), got {tuple(x.shape)}; {REMEDY}")


def check_arguments(q0: Tensor, q1: Tensor, s0: Tensor, names: tuple[str, ...] = ("q0", "q1", "s0")) -> None:
    """Raise InputError for an argument that is no tensor, or positions without a last axis for the coordinates."""
    check_positions(**{names[0]: q0, names[1]: q1})
    check_tensors(**{names[2]: s0})


REMEDY = (
    "one coordinate is q = torch.tensor([1.0], dtype=torch.float64), with s = torch.tensor(0.0, dtype=torch.float64)"
)


# What torch says where the derivative of a compiled function shall have derivatives.
OF_COMPILED = ("donated buffers", "does not currently support double backward")
# What torch says of tensors that do not fit together.
OF_SHAPES = ("have the same dtype", "expected scalar type", "size of tensor", "shapes cannot be multiplied")


def called(L_d: DiscreteLagrangian, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """L_d(q0, q1, s0, h); raise InputError if L_d takes another number of arguments, or other shapes or dtypes."""
    try:
        return L_d(q0, q1, s0, h)
    except RuntimeError as error:
        if not any(words in str(error) for words in OF_SHAPES):
            raise
        own = next(iter(L_d.parameters()), None) if isinstance(L_d, torch.nn.Module) else None
        holds = "" if own is None else f", and its parameters are {own.dtype}"
        raise InputError(
            f"{_name(L_d)} does not take positions of shape {tuple(q0.shape)} and {q0.dtype}, with s0 and h of shape "
            f"{tuple(s0.shape)} and {tuple(h.shape)}{holds}: {str(error).splitlines()[0]}"
        ) from None
    except TypeError as error:
        if "positional argument" not in str(error) or _takes_four(L_d):
            raise
        raise InputError(
            f"{_name(L_d)} must take four arguments, L_d(q0, q1, s0, h): {error}; add the missing arguments, and "
            "0 * s0 where nothing depends on s"
        ) from None


def _takes_four(L_d: Any) -> bool:
    """Whether a function accepts four arguments by position; True for a function without a signature."""
    try:
        signature(L_d.forward if isinstance(L_d, torch.nn.Module) else L_d).bind(*range(4))
    except TypeError:
        return False
    except ValueError:
        pass
    return True


def checked(L_d: Any, L: Any, like: Tensor) -> Tensor:
    """L, if L is a tensor of the shape (...) of `like`; otherwise raise InputError.

    A shape that only broadcasts would step to a wrong number in silence.
    """
    if isinstance(L, Tensor) and L.shape == like.shape:
        return L
    name = _name(L_d)
    got = f"shape {tuple(L.shape)}" if isinstance(L, Tensor) else f"a {type(L).__name__}"
    raise InputError(
        f"{name} returned {got} where {tuple(like.shape)}, one number per sample, belongs; "
        "sum over coordinates with .sum(-1), and add 0 * s0 where nothing depends on a sample"
    )


def _check_alone(L_d: Any, L: Tensor, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> None:
    """Raise InputError if the first sample depends on the h of other samples, as with (q1 − q0) / h."""
    if L.numel() < 2 or in_vmap(L):
        return
    first = (0,) * L.ndim
    steps = 2 * h.detach().expand(L.shape).clone()
    steps[first] /= 2
    with torch.no_grad():
        other = float(L_d(q0.detach(), q1.detach(), s0.detach(), steps)[first])
    one = float(L.detach()[first])
    if abs(one - other) > torch.finfo(L.dtype).eps ** 0.5 * (abs(one) + abs(other)):
        raise InputError(
            f"{_name(L_d)} mixes samples: other steps of the other samples change the first one from {one:g} to "
            f"{other:g}; write h[..., None] beside positions, as in (q1 - q0) / h[..., None]"
        )


@contextmanager
def _refused_if_compiled() -> Iterator[None]:
    """Raise InputError where torch finds that a function of torch.compile has no second derivatives."""
    try:
        yield
    except RuntimeError as error:
        if not any(words in str(error) for words in OF_COMPILED):
            raise
        raise InputError(
            "L_d was compiled by torch.compile, whose derivatives cannot be differentiated again, as steps and losses "
            "need; give the module that was compiled (hz.compile(stepper) makes fast steps of a trained one)"
        ) from None


def _name(L_d: Any) -> str:
    return getattr(L_d, "__name__", type(L_d).__name__).replace("<lambda>", "the function")


def autograd_partials(
    L_d: DiscreteLagrangian, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor | float, order: int = 1
) -> Partials:
    """Return the result of `partials`, always by autograd: the slow twin that closed forms are tested against.

    Samples do not interact, so the gradient of the sum over samples is the batch of gradients. Within `torch.func`,
    which autograd does not nest in, the result is that of `functional_partials`.
    """
    h = torch.as_tensor(h, dtype=q0.dtype, device=q0.device)
    if torch._C._are_functorch_transforms_active():
        return functional_partials(L_d, q0, q1, s0, h, order)
    q0, q1, s0, h = map(normal, (q0, q1, s0, h))
    q0, q1, s0, _ = torch.broadcast_tensors(q0, q1, s0[..., None], h[..., None])
    s0 = s0[..., 0]
    keep_graph = torch.is_grad_enabled() and _differentiable(L_d, q0, q1, s0, h)
    # Autograd records nothing in inference mode.
    with torch.inference_mode(False), torch.enable_grad(), _refused_if_compiled():
        q0, q1, s0 = (x if x.requires_grad else x.detach().requires_grad_() for x in (q0, q1, s0))
        # `* 1` gives each argument a graph node of its own, so that views of one tensor differentiate separately.
        a, b, s = q0 * 1, q1 * 1, s0 * 1
        L = checked(L_d, called(L_d, a, b, s, h), s)
        if h.ndim:
            _check_alone(L_d, L, a, b, s, h)
        forces = L_d.forces(a, b, s, h) if isinstance(L_d, Forced) else None
        force = None if forces is None else _autograd_forces(forces, (a, b, s), order, keep_graph)
        D1, D2, D3 = _grad(L, (a, b, s), create_graph=keep_graph or order == 2)
        P = Partials(L, D1, D2, D3, force=force)
        if order == 2:
            gradient = torch.cat([D1, D2, D3[..., None]], -1)
            P = replace(P, **second_blocks(*rows_of(gradient, (a, b, s), keep_graph)))
    return P if keep_graph else P.map(Tensor.detach)


def second_blocks(by_q0: Tensor, by_q1: Tensor, by_s: Tensor) -> dict[str, Tensor]:
    """The second derivatives of `Partials` from those of (D1, D2, D3): (..., 2n+1, n) twice, and (..., 2n+1)."""
    n = by_q0.shape[-1]
    return {
        "D11": by_q0[..., :n, :], "D12": by_q1[..., :n, :], "D22": by_q1[..., n : 2 * n, :],
        "D13": by_s[..., :n], "D23": by_s[..., n : 2 * n], "D33": by_s[..., 2 * n],
    }  # fmt: skip


def _autograd_forces(
    forces: tuple[Tensor, Tensor], xs: tuple[Tensor, Tensor, Tensor], order: int, keep_graph: bool
) -> Forces:
    """F⁻ and F⁺, with their derivatives at order 2."""
    minus, plus = forces
    if order == 1:
        return Forces(minus, plus)
    return Forces(minus, plus, *(block for F in forces for block in rows_of(F, xs, keep_graph)))


def _differentiable(L_d: DiscreteLagrangian, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> bool:
    """Whether the result carries a graph: an argument or a parameter inside L_d requires a gradient."""
    if q0.requires_grad or q1.requires_grad or s0.requires_grad:
        return True
    return checked(L_d, called(L_d, q0, q1, s0, h), s0).requires_grad


def _grad(y: Tensor, xs: tuple[Tensor, ...], create_graph: bool) -> tuple[Tensor, ...]:
    """Gradient of y.sum() by every x; zeros for an x that y does not depend on."""
    if not y.requires_grad:
        return tuple(torch.zeros_like(x) for x in xs)
    grads = torch.autograd.grad(y.sum(), xs, create_graph=create_graph, allow_unused=True)
    return tuple(torch.zeros_like(x) if g is None else g for g, x in zip(grads, xs, strict=True))


def functional_partials(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor,  # () or (...)
    order: int = 1,
) -> Partials:
    """Return the result of `autograd_partials` by function transforms, which nest: (...) may be a sample in `vmap`.

    Samples do not interact, so one product with the Jacobian of the batch is the batch of gradients. The second
    derivatives are 2n + 1 products with the Jacobian of the gradients. L_d must be a pure function of tensors.
    """
    q0, q1, s, steps = torch.broadcast_tensors(q0, q1, s0[..., None], h[..., None])
    xs, h = (q0, q1, s[..., 0]), steps[..., 0]

    def first(*x: Tensor) -> tuple[Tensor, Tensor]:
        L, pull = cast(Any, vjp(lambda q0, q1, s: checked(L_d, called(L_d, q0, q1, s, h), s), *x))
        D1, D2, D3 = pull(torch.ones_like(L))
        return torch.cat([D1, D2, D3[..., None]], -1), L

    force = _functional_forces(L_d, xs, h, order) if isinstance(L_d, Forced) else None
    if order == 1:
        D, L = first(*xs)
        return Partials(L, *split(D), force=force)
    D, by, L = _functional_rows(first, xs)
    return Partials(L, *split(D), **second_blocks(*by), force=force)


def _functional_rows(
    function: Callable[..., tuple[Tensor, Any]], xs: tuple[Tensor, ...]
) -> tuple[Tensor, list[Tensor], Any]:
    """The value y (..., m), ∂y/∂x of every x (..., m, *), and the function's second result."""
    y, pull, rest = cast(Any, vjp(function, *xs, has_aux=True))
    units = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
    rows = [pull(unit.expand(y.shape)) for unit in units.unbind()]
    return y, [torch.stack(x, y.ndim - 1) for x in zip(*rows, strict=True)], rest


def _functional_forces(L_d: Forced, xs: tuple[Tensor, Tensor, Tensor], h: Tensor, order: int) -> Forces | None:
    """F⁻ and F⁺, with their derivatives at order 2."""
    found = L_d.forces(*xs, h)
    if found is None or order == 1:
        return None if found is None else Forces(*found)

    # The second result is an empty tuple: torch.func accepts no None there.
    def both(*x: Tensor) -> tuple[Tensor, tuple[()]]:
        return torch.cat(cast(Any, L_d).forces(*x, h), -1), ()

    n = xs[0].shape[-1]
    F, by, _ = _functional_rows(both, xs)
    minus = F[..., :n], *(x.narrow(F.ndim - 1, 0, n) for x in by)
    plus = F[..., n:], *(x.narrow(F.ndim - 1, n, n) for x in by)
    return Forces(minus[0], plus[0], *minus[1:], *plus[1:])


ScalarField = Callable[[Tensor, Tensor, Tensor], Tensor]
Hamiltonian = ScalarField
Lagrangian = ScalarField


def derivatives(
    f: ScalarField,
    q: Tensor,  # (..., n)
    x: Tensor,  # (..., n) p or v
    s: Tensor,  # (...)
    order: int = 1,
) -> Partials:
    """f(q, x, s) and its derivatives: D1 = f_q, D2 = f_x, D3 = f_s, D12 = f_qx and so on."""
    return autograd_partials(lambda q, x, s, h: f(q, x, s), q, x, s, 0.0, order)  # noqa: ARG005


def gradient(
    F: Callable[[Tensor], Tensor],  # (..., m) → (...)
    x: Tensor,  # (..., m)
    order: int = 1,
) -> tuple[Tensor, Tensor, Tensor]:
    """F, F_x and (order 2) F_xx with shapes (...), (..., m), (..., m, m)."""
    P = autograd_partials(lambda x, _, s, h: F(x), x, x, x[..., 0], 0.0, order)  # noqa: ARG005
    return P.L, P.D1, P.D11
