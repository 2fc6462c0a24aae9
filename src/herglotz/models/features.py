"""Grey-box features: functions of (q, v) that a user names, as text, and whose coefficients are learned or known.

A feature without velocities joins the potential V, one with velocities the kinetic term K. It is a sum of products,
each of one function of the position and any number of velocities:

    cos(q1 - q2) v1 v2        (q2 - q1)^4 + (q3 - q2)^4        0.5 r^-1        q1 v2 - q2 v1

with cos, sin and whole powers of a linear form of the q, whole powers of r = |q|, and |q1| q1 or |q1|^3 of a length:
the force of the first is |q1|, that of a spring which is stiffer on one side. One coefficient multiplies the
whole sum, which is how parameters are shared. Short names stand for lists of features (`LIBRARIES`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import signature
from itertools import combinations, combinations_with_replacement, product

from herglotz.errors import InputError
from herglotz.models.feature_grammar import Feature, Product, parse

__all__ = ["LIBRARIES", "Feature", "Product", "expand", "parse"]


def expand(names: Sequence[str], angles: Sequence[bool]) -> list[str]:
    """Features with the names of libraries replaced by what they stand for, each feature once."""
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
    """Springs between neighbours and to both walls, all alike: powers 2 … `highest` of the stretches."""
    n = len(angles)
    stretches = ["(q1)", *(f"(q{i + 1} - q{i})" for i in range(1, n)), f"(-q{n})"]
    return [" + ".join(f"{s}^{power}" for s in stretches) for power in range(2, highest + 1)]


def sites(angles: Sequence[bool], highest: int = 4) -> list[str]:
    """Springs that hold each coordinate by itself, all alike: powers 1 … `highest`."""
    every = range(1, len(angles) + 1)
    return [" + ".join(f"q{i}^{power}" for i in every) for power in range(1, highest + 1)]


def central(angles: Sequence[bool], highest: int = 3) -> list[str]:  # noqa: ARG001  one signature for all
    """A potential of the distance r = |q| alone: powers −`highest` … `highest`."""
    return [f"r^{k}" for k in range(-highest, highest + 1) if k]


def pendulums(angles: Sequence[bool]) -> list[str]:
    """Links in a plane, their angles from one direction: each pair of speeds is coupled by cos(q_i − q_j)."""
    return [f"cos(q{i + 1} - q{j + 1}) v{i + 1} v{j + 1}" for i, j in combinations(range(len(angles)), 2)]


def harmonics(angles: Sequence[bool], highest: int = 2) -> list[str]:
    """Waves cos and sin of k·q, Σ|k_i| ≤ `highest`, of the angles: in the potential and in every entry of the mass."""
    return _waves(angles, highest, highest)


def revolute(angles: Sequence[bool]) -> list[str]:
    """Waves cos and sin of k·q with every |k_i| ≤ 1, in the potential and in every entry of the mass.

    That is exact for every chain of links in a plane, whether its angles are absolute or those between neighbours.
    """
    return _waves(angles, 1, len(angles))


def lengths(angles: Sequence[bool]) -> list[str]:
    """Frequent features of coordinates that are no angles, singly and in pairs.

    Powers 2, 3 and 4 of each difference of two, 3 and 4 of each coordinate. Of two or three coordinates also those
    powers of sums, a potential of the distance r = |q|, and forces across the velocity (a magnetic field, a frame that
    turns).
    """
    n = len(angles)
    pairs = [(i + 1, j + 1) for i, j in combinations(range(n), 2)]
    names = [f"(q{i} - q{j})^{power}" for power in (2, 3, 4) for i, j in pairs]
    names += [f"q{i + 1}^{power}" for power in (3, 4) for i in range(n)]
    if 1 < n <= 3:
        names += [f"(q{i} + q{j})^{power}" for power in (3, 4) for i, j in pairs]
        names += [name for name in central(angles) if name != "r^2"]  # the baseline's
        names += [f"q{i} v{j} - q{j} v{i}" for i, j in pairs]
    return names


def _waves(angles: Sequence[bool], highest: int, total: int) -> list[str]:
    """The waves of k·q with |k_i| ≤ highest and Σ|k_i| ≤ total, but those of V that the baseline has."""
    which = [i for i, angle in enumerate(angles, 1) if angle]
    numbers = product(range(-highest, highest + 1), repeat=len(which))
    forms = [_form(k, which) for k in numbers if 0 < sum(map(abs, k)) <= total and k > (0,) * len(k)]
    own = [f"q{i}" for i in which]  # the baseline's
    pairs = [f"v{i} v{j}" for i, j in combinations_with_replacement(range(1, len(angles) + 1), 2)]
    waves = [f"{f}({form})" for form in forms for f in ("cos", "sin")]
    alone = [f"{f}({form})" for form in forms if form not in own for f in ("cos", "sin")]
    return alone + [f"{wave} {pair}" for pair in pairs for wave in waves]


def _form(k: Sequence[int], which: Sequence[int]) -> str:
    """k·q as text, of the coordinates `which`."""
    numbers = {1: "", -1: "-"}
    return " + ".join(f"{numbers.get(x, x)}q{i}" for x, i in zip(k, which, strict=True) if x).replace("+ -", "- ")


LIBRARIES: dict[str, Callable[..., list[str]]] = {
    "chain": chain,
    "sites": sites,
    "central": central,
    "pendulums": pendulums,
    "harmonics": harmonics,
    "revolute": revolute,
    "lengths": lengths,
}
