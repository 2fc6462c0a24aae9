"""Grey-box features: functions of (q, v) that a user names as text, with learned or known coefficients.

A feature without velocities joins the potential V, a feature with velocities the kinetic term K. A feature is a sum of
products, each of at most one function of the position, a power beside a wave, and any number of velocities:

    cos(q1 - q2) v1 v2        (q2 - q1)^4 + (q3 - q2)^4        0.5 r^-1        q1 v2 - q2 v1        q1 cos(q2)

The functions are cos, sin and whole powers of a linear form of the q, whole powers of r = |q|, and |q1| q1 or |q1|^3
of a length: |q1| q1 has the force |q1| of a spring that is stiffer on one side. One coefficient multiplies the whole
sum, so that the products share a parameter. Short names stand for lists of features (`LIBRARIES`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import signature
from itertools import combinations, combinations_with_replacement, permutations, product

from herglotz.errors import InputError
from herglotz.models.feature_grammar import Feature, Product, parse

__all__ = ["LIBRARIES", "Feature", "Product", "expand", "parse"]


def expand(names: Sequence[str], angles: Sequence[bool]) -> list[str]:
    """The features with every library name replaced by the features of that library, each feature once."""
    out: list[str] = []
    for name in names:
        word, _, argument = name.partition(" ")
        library = LIBRARIES.get(word)
        if library is None:
            out.append(name)
        elif argument and len(signature(library).parameters) == 1:
            raise InputError(f"feature '{name}': this library takes no number; write '{word}'")
        elif argument and not argument.strip().isdigit():
            raise InputError(f"feature '{name}': this library takes one whole number, as '{word} 2' does")
        else:
            out += library(angles, *([int(argument)] if argument else []))
    return list(dict.fromkeys(out))


def chain(angles: Sequence[bool], highest: int = 4) -> list[str]:
    """Equal springs between neighbours and to both walls: powers 2 … `highest` of the stretches."""
    n = len(angles)
    stretches = ["(q1)", *(f"(q{i + 1} - q{i})" for i in range(1, n)), f"(-q{n})"]
    return [" + ".join(f"{s}^{power}" for s in stretches) for power in range(2, highest + 1)]


def sites(angles: Sequence[bool], highest: int = 4) -> list[str]:
    """Equal springs from every coordinate to a wall: powers 1 … `highest`."""
    coordinates = range(1, len(angles) + 1)
    return [" + ".join(f"q{i}^{power}" for i in coordinates) for power in range(1, highest + 1)]


# Every library has the argument `angles`.
def central(angles: Sequence[bool], highest: int = 3) -> list[str]:  # noqa: ARG001
    """A potential of the distance r = |q|: powers −`highest` … `highest`."""
    return [f"r^{k}" for k in range(-highest, highest + 1) if k]


def pendulums(angles: Sequence[bool]) -> list[str]:
    """Links in a plane with absolute angles: cos(q_i − q_j) couples each pair of speeds."""
    return [f"cos(q{i + 1} - q{j + 1}) v{i + 1} v{j + 1}" for i, j in combinations(range(len(angles)), 2)]


def harmonics(angles: Sequence[bool], highest: int = 2) -> list[str]:
    """Waves cos and sin of k·q, Σ|k_i| ≤ `highest`, of the angles: in the potential and in every entry of the mass."""
    return _waves(angles, highest, highest)


def revolute(angles: Sequence[bool]) -> list[str]:
    """Waves cos and sin of k·q with every |k_i| ≤ 1, in the potential and in every entry of the mass.

    The library is exact for every chain of links in a plane, with absolute angles or angles between neighbours.
    """
    return _waves(angles, 1, len(angles))


def spherical(angles: Sequence[bool]) -> list[str]:
    """Joints q_j that turn about an axis across that of another joint q_i: the mass of q_i has cos 2q_j.

    A link with the angle q_j to the axis of q_i, as a spherical or a rotary pendulum has, adds m l² sin² q_j v_i²/2 to
    K.
    """
    turning = [i for i, angle in enumerate(angles, 1) if angle]
    return [f"cos(2q{j}) v{i} v{i}" for i, j in permutations(turning, 2)]


def lengths(angles: Sequence[bool]) -> list[str]:
    """Frequent features of coordinates that are no angles, singly and in pairs.

    Powers 2, 3 and 4 of each difference of two, 3 and 4 of each coordinate. For two or three coordinates also powers 3
    and 4 of sums, a potential of the distance r = |q|, and forces across the velocity (a magnetic field, a rotating
    frame). The baseline already has r².
    """
    n = len(angles)
    pairs = [(i + 1, j + 1) for i, j in combinations(range(n), 2)]
    names = [f"(q{i} - q{j})^{power}" for power in (2, 3, 4) for i, j in pairs]
    names += [f"q{i + 1}^{power}" for power in (3, 4) for i in range(n)]
    if 1 < n <= 3:
        names += [f"(q{i} + q{j})^{power}" for power in (3, 4) for i, j in pairs]
        names += [name for name in central(angles) if name != "r^2"]
        names += [f"q{i} v{j} - q{j} v{i}" for i, j in pairs]
    return names


def slides(angles: Sequence[bool]) -> list[str]:
    """Slides q_i that joints q_j turn: weight, the mass of the joint, and masses between the joint and other speeds.

    A mass m at the distance q_i on a link with the angle q_j adds m q_i² v_j²/2 to K and m g q_i cos q_j to V; terms of
    the first power of q_i say where its zero is.
    """
    coordinates = range(1, len(angles) + 1)
    names = []
    for i, j in product((i for i in coordinates if not angles[i - 1]), (j for j in coordinates if angles[j - 1])):
        names += [f"q{i} cos(q{j})", f"q{i} sin(q{j})", f"q{i} v{j}^2", f"q{i}^2 v{j}^2"]
        names += [f"q{i} {f}(q{j}) v{j} v{k}" for k in coordinates if k not in (i, j) for f in ("cos", "sin")]
    return names


def _waves(angles: Sequence[bool], highest: int, total: int) -> list[str]:
    """The waves of k·q with |k_i| ≤ highest and Σ|k_i| ≤ total, without the baseline's cos qᵢ and sin qᵢ in V."""
    which = [i for i, angle in enumerate(angles, 1) if angle]
    numbers = product(range(-highest, highest + 1), repeat=len(which))
    forms = [_form(k, which) for k in numbers if 0 < sum(map(abs, k)) <= total and k > (0,) * len(k)]
    baseline = [f"q{i}" for i in which]
    pairs = [f"v{i} v{j}" for i, j in combinations_with_replacement(range(1, len(angles) + 1), 2)]
    waves = [f"{f}({form})" for form in forms for f in ("cos", "sin")]
    alone = [f"{f}({form})" for form in forms if form not in baseline for f in ("cos", "sin")]
    return alone + [f"{wave} {pair}" for pair in pairs for wave in waves]


def _form(k: Sequence[int], which: Sequence[int]) -> str:
    """k·q of the coordinates `which`, as text."""
    numbers = {1: "", -1: "-"}
    return " + ".join(f"{numbers.get(x, x)}q{i}" for x, i in zip(k, which, strict=True) if x).replace("+ -", "- ")


LIBRARIES: dict[str, Callable[..., list[str]]] = {
    "chain": chain,
    "sites": sites,
    "central": central,
    "pendulums": pendulums,
    "harmonics": harmonics,
    "revolute": revolute,
    "slides": slides,
    "spherical": spherical,
    "lengths": lengths,
}
