"""A scene: a mechanical system with a known answer, as data and functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian

StateFunction = Callable[[Tensor, Tensor, Tensor], Tensor]
State = tuple[Tensor, Tensor, Tensor]
Step = Tensor | float
Range = tuple[float, float] | tuple[tuple[float, ...], tuple[float, ...]]  # (low, high), numbers or (n,) each


@dataclass(frozen=True, repr=False)
class Scene:
    """A contact system with its continuous and discrete descriptions.

    Functions are batched over leading dimensions: positions, velocities and momenta are (..., n), the action variable
    s is (...), the step h is a number or a tensor (...). Units follow `units` and `time_unit`.

    Parameters
    ----------
    hamiltonian, lagrangian
        H(q, p, s) and L(q, v, s), shape (...), with ṡ = L and H = v·L_v − L.
    momentum, velocity
        p = L_v(q, v, s) and v = H_p(q, p, s), shape (..., n), inverse to each other.
    flow
        (q, p, s, h) → (q1, p1, s1) in closed form, or the high-accuracy reference flow.
    L_d
        The principal discrete Lagrangian L_d(q0, q1, s0, h); `exact`: L_d generates `flow` exactly.
    L_d_rules
        The discretisations of this scene by name, none of them exact.
    q_range, v_range, h
        Ranges of initial positions and velocities, and the step, of examples and generated data. A range (low, high)
        has two numbers, or two tuples of `dof` numbers.
    numerical
        The exact L_d by collocation (`herglotz.scenes.exact`), of a scene without a closed form.
    examples
        Parameters other than the defaults, for tests: a default of 1 hides powers.
    external
        f(q, v), (..., n), a force besides that of the Lagrangian: ṗ = L_q + L_s p + f. None: the flow is a contact
        flow. If `flow` has a set-valued force, `external` is its smoothed form.
    at, drive
        For a scene with inputs: the scene at constant inputs u, (..., m), and the given inputs, t (...) ↦ u.
    """

    name: str
    description: str
    coordinates: tuple[str, ...]
    units: tuple[str, ...]
    parameters: Mapping[str, float]
    hamiltonian: StateFunction
    lagrangian: StateFunction
    momentum: StateFunction
    velocity: StateFunction
    flow: Callable[[Tensor, Tensor, Tensor, Step], State]
    L_d: DiscreteLagrangian
    exact: bool
    L_d_rules: Mapping[str, DiscreteLagrangian]
    q_range: Range
    v_range: Range
    h: float
    time_unit: str = "s"
    numerical: DiscreteLagrangian | None = None
    examples: tuple[Mapping[str, float], ...] = ()
    at: Callable[[Tensor], Scene] | None = None
    drive: Callable[[Tensor], Tensor] | None = None
    external: Callable[[Tensor, Tensor], Tensor] | None = None

    def __repr__(self) -> str:
        return f"Scene({self.name}: {', '.join(self.coordinates)})"

    @property
    def dof(self) -> int:
        """The number n of coordinates."""
        return len(self.coordinates)

    @property
    def angles(self) -> tuple[bool, ...]:
        """(n,) whether each coordinate is an angle, in rad."""
        return tuple(unit == "rad" for unit in self.units)


def require_positive(scene: str, **numbers: float) -> None:
    """Raise InputError for a parameter that is not positive; `_` in its name stands for a blank."""
    for name, value in numbers.items():
        if not value > 0:
            raise InputError(f"{scene}: {name.replace('_', ' ')} must be > 0, got {value}")
