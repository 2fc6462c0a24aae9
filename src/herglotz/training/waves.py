"""The waves of learned functions: sines and cosines of coordinates and speeds over an interval, longest waves first.

A function on an interval is a sum of the sine waves that vanish at both ends (`functions`). Functions of an angle are
sums of the harmonics of the angle. Functions of a speed, and of two coordinates, are sums of cos and sin whose period
is the interval. Intervals change the numbers in the waves, and never which multiples of these numbers there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations, combinations_with_replacement

# Waves of the potential of the only coordinate, if a length.
POTENTIAL_WAVES = 47
# Waves of the potential of each of several lengths, and harmonics of an angle.
POTENTIAL_WAVES_OF_MANY = 15
# Pairs of cos and sin of the potential of two lengths together.
PLANE_PAIRS = 80
# Waves of the mass of the only coordinate.
MASS_WAVES = 15
# Pairs of cos and sin of the damping as a function of position: of the only coordinate, and of each of several.
DAMPING_PAIRS, DAMPING_PAIRS_OF_MANY = 7, 3
# Pairs of cos and sin of the friction as a function of speed.
FRICTION_PAIRS = 7

# Names of functions that are dissipative forces, and no part of L, begin with these words.
BRAKES = ("damping", "friction")

# A linear form Σ w q_i as pairs (i, w), and the text of a wave with its rate k.
Form = list[tuple[int, float]]
Wave = tuple[str, float]


def waves_of(
    angles: Sequence[bool],
    interval: Callable[[Form], tuple[float, float]],
    speeds: Sequence[float],
    *,
    plane: bool,
    fine: bool = False,
) -> dict[str, list[Wave]]:
    """The waves of all functions that a model of these coordinates may have, by the name of the function.

    `interval` has the middle and half the length of the interval of a linear form, `speeds` (n,) half the lengths of
    the intervals of the speeds. `plane`: two lengths have a potential of both. `fine`: the damping and the mass of the
    only coordinate have waves as short as those of the potential, which would be too many for a search.
    """
    n, several, found = len(angles), len(angles) > 1, {}
    pairs, mass = DAMPING_PAIRS_OF_MANY if several else DAMPING_PAIRS, MASS_WAVES
    if fine and not several:
        pairs, mass = POTENTIAL_WAVES // 2, POTENTIAL_WAVES
    count = POTENTIAL_WAVES_OF_MANY if several else POTENTIAL_WAVES
    for i, angle in enumerate(angles):
        own = _harmonics(i) if angle else _sines([(i, 1.0)], interval([(i, 1.0)]), count)
        found[f"V(q{i + 1})"] = own
        around = own if angle else _pairs(f"q{i + 1}", interval([(i, 1.0)])[1], pairs)
        found[f"damping(q{i + 1})"] = [(f"{x} v{i + 1}", k) for x, k in around[: 2 * pairs]]
        found[f"friction(v{i + 1})"] = _pairs(f"v{i + 1}", speeds[i], FRICTION_PAIRS)
        if not several:
            found["mass(q1)"] = [(f"{x} v1^2", k) for x, k in own[: 2 * mass if angle else mass]]
        elif angle:
            for a, b in combinations_with_replacement(range(1, n + 1), 2):
                found[f"mass(q{i + 1}) of v{a} v{b}"] = [(f"{x} v{a} v{b}", k) for x, k in own[2:4]]
    for i, j in combinations(range(n), 2):
        if angles[i] or angles[j]:
            continue
        stretch = [(j, 1.0), (i, -1.0)]
        found[f"V(q{j + 1} - q{i + 1})"] = _sines(stretch, interval(stretch), POTENTIAL_WAVES_OF_MANY)
        found[f"friction(v{j + 1} - v{i + 1})"] = _pairs(
            f"(v{j + 1} - v{i + 1})", speeds[i] + speeds[j], FRICTION_PAIRS
        )
        if n == 2 and plane:
            found[f"V(q{i + 1}, q{j + 1})"] = _plane(interval([(i, 1.0)])[1], interval([(j, 1.0)])[1])
    return found


def _sines(form: Form, interval: tuple[float, float], count: int) -> list[Wave]:
    """sin(k (x − a)) of a linear form x, zero at both ends of the interval of x, which begins at a; with rates k."""
    middle, half = interval
    longest, found = _short(math.pi / (2 * half)), []
    # A positive phase, whatever the interval: the sign is no number of the wave.
    phase = _short(longest * (half - middle) % (2 * math.pi))
    for j in range(1, count + 1):
        parts = [(w * j * longest, f" q{i + 1}") for i, w in form] + [(j * phase, "")]
        text = " ".join(f"{'-' if w < 0 else '+'} {abs(w):.10g}{what}" for w, what in parts)
        found.append((f"sin({text.removeprefix('+ ')})", j * longest))
    return found


def _pairs(x: str, half: float, count: int) -> list[Wave]:
    """Pairs of cos and sin of a variable x whose period is its interval, of half length `half`."""
    rates = [j * _short(math.pi / half) for j in range(1, count + 1)]
    return [(f"{f}({k:.10g} {x})", k) for k in rates for f in ("cos", "sin")]


def _plane(half_1: float, half_2: float) -> list[Wave]:
    """Plane waves of q1 and q2 with the periods of both intervals, the longest waves first.

    The multiples of the two rates are those of the longest waves over intervals of equal lengths.
    """
    a, b = _short(math.pi / half_1), _short(math.pi / half_2)
    multiples = ((m, n) for m in range(PLANE_PAIRS) for n in range(-PLANE_PAIRS, PLANE_PAIRS) if m or n > 0)
    few = sorted(multiples, key=lambda pair: (math.hypot(*pair), pair))[:PLANE_PAIRS]
    found = []
    for k, x, y in sorted((math.hypot(m * a, n * b), m * a, n * b) for m, n in few):
        parts = [f"{abs(w):.10g} q{at}" for w, at in ((x, 1), (y, 2)) if w]
        found += [(f"{f}({(' - ' if y < 0 else ' + ').join(parts)})", k) for f in ("cos", "sin")]
    return found


def _short(x: float) -> float:
    """Round x to seven digits: ten printed digits then hold multiples exactly, and sin k x follows from sin x."""
    return float(f"{x:.7g}")


def _harmonics(i: int) -> list[Wave]:
    """Pairs of cos and sin of whole multiples of an angle."""
    multiples = range(1, POTENTIAL_WAVES_OF_MANY + 1)
    return [(f"{f}({'' if k == 1 else k}q{i + 1})", float(k)) for k in multiples for f in ("cos", "sin")]
