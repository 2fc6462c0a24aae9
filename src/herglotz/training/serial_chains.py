"""Offers of serial chains of joints, as arms and multiple pendulums are, among all terms of a dictionary.

Masses of a chain depend on sums of the relative angles of neighbouring joints behind the first joint; in absolute
angles, on the difference of the two angles whose speeds they multiply. A dictionary of three angles has these few terms
among 200, whose fit may end far from the law.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import combinations, combinations_with_replacement

from herglotz.training.offers import INPUTS

# Offers of every chain, by the start of their names: constant masses, weights and springs, damping, and inputs.
PLAIN = ("kinetic.off_diagonal", "potential.", "friction.viscous", "coupling.viscous", INPUTS)


def serial_chains(angles: Sequence[bool], offers: Collection[str]) -> list[frozenset[str]]:
    """The names of the offers of a chain in relative angles and in absolute angles; [] for fewer than two angles."""
    joints = [i for i, angle in enumerate(angles, 1) if angle]
    if len(joints) < 2:
        return []
    runs = [joints[a : b + 1] for a, b in combinations_with_replacement(range(len(joints)), 2)]
    sums = {" + ".join(f"q{i}" for i in run): run[0] for run in runs}
    speeds = [f"v{i} v{j}" for i, j in combinations_with_replacement(joints, 2)]
    relative = {f"cos({x}) {pair}" for x, first in sums.items() if first > joints[0] for pair in speeds}
    weights = {f"{wave}({x})" for x in sums for wave in ("cos", "sin")}
    absolute = {f"cos(q{i} - q{j}) v{i} v{j}" for i, j in combinations(joints, 2)}
    plain = {name for name in offers if name.startswith(PLAIN)}
    return [frozenset(plain | own.intersection(offers)) for own in (relative | weights, absolute)]
