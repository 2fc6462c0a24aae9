"""Translations that a model has by construction: nothing in it that depends on the position sees them.

A translation is named by what moves together, "q1 + q2" or "q1 - 0.5 q2": q ↦ q + ε d, with d the numbers of that form.
Networks read their features through the projection on the complement of d, features must be functions of what d leaves
alone, and the baseline's springs act on the projected position. L_d is then invariant, so that J = p·d obeys
J_{k+1} = c_k J_k to rounding at every step (`herglotz.theory.symmetries` finds what to ask for).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.models.feature_grammar import parse
from herglotz.models.features import expand

SAME = 1e-9  # of 1: what the pseudo-inverse rounds
HOW = "name what moves together, as 'q1 + q2'"


def directions(texts: Sequence[str], angles: Sequence[bool]) -> list[tuple[float, ...]]:
    """The d of every translation, n numbers each.

    Raise InputError if a text is no linear form of coordinates, or moves an angle together with another coordinate.
    """
    found = []
    for text in texts:
        try:
            d = parse(f"sin({text})", angles)[0].form  # the sine of a form may hold angles
        except InputError as error:
            raise InputError(f"translation '{text}': {str(error).split(': ', 1)[-1]}; {HOW}") from None
        if not any(d):
            raise InputError(f"translation '{text}': is no direction; {HOW}")
        if any(w and a for w, a in zip(d, angles, strict=True)) and sum(map(bool, d)) > 1:
            raise InputError(
                f"translation '{text}': an angle is translated alone; name features of differences instead"
            )
        found.append(d)
    return found


def check_translations(config: Any) -> None:
    """Raise `InputError` where a term of the model would see a translation that the model is to have."""
    moved = directions(config.translations, config.angles)
    if not moved:
        return
    sees = {
        "a mass that depends on position": config.mass_width > 0,
        "the level full": config.level == "full",
        "terms by name": bool(config.terms),
        "drag that depends on position": any("q" in text for text in config.drag),
    }
    for what in (name for name, is_there in sees.items() if is_there):
        raise InputError(f"translations: {what} would see them; leave it out, or the translations")
    for text in expand((*config.features, *config.known), config.angles):
        if not unchanged(text, config.angles, moved):
            raise InputError(f"feature '{text}': changes under the translation; name one of differences")


def unchanged(text: str, angles: Sequence[bool], moved: Sequence[tuple[float, ...]]) -> bool:
    """Whether no product of a feature sees the position along any of the directions."""
    return not any(
        (product.power or any(product.form))
        and (product.function == "radius" or any(abs(sum(map(float.__mul__, product.form, d))) > SAME for d in moved))
        for product in parse(text, angles)
    )


def differences(angles: Sequence[bool], moved: Sequence[tuple[float, ...]]) -> list[str]:
    """Forms of two moved lengths, "(q1 - q2)", that the first direction in which both move leaves alone."""
    found = []
    for (i, a), (j, b) in combinations(enumerate(zip(*moved, strict=True)), 2):
        by = next((y / x for x, y in zip(a, b, strict=True) if x and y), 0.0)
        if by and not (angles[i] or angles[j]):
            first = f"q{i + 1}" if abs(by) == 1 else f"{abs(by)!r}q{i + 1}"
            found.append(f"({first} - q{j + 1})" if by > 0 else f"({first} + q{j + 1})")
    return found


def projection(translations: Sequence[str], angles: Sequence[bool]) -> Tensor | None:
    """(n, n) P with P d = 0 for every translation d and P x = x across them; None without translations."""
    moved = directions(translations, angles)
    return _across(torch.tensor(moved, dtype=torch.float64)) if moved else None


def across_in_words(P: Tensor, names: Sequence[str]) -> list[tuple[str, float]]:
    """The rows of a projection as "(x − y)" with the factor before it, "" for an empty one."""
    found = []
    for row in P.tolist():
        size = next((w for w in row if w), 1.0)
        parts = [(w / size, name) for w, name in zip(row, names, strict=True) if w]
        texts = [
            f"{'−' if w < 0 else '+'} {'' if abs(abs(w) - 1) < SAME else f'{abs(w):.10g} '}{name}" for w, name in parts
        ]
        form = " ".join(texts).removeprefix("+ ")
        found.append((f"({form})" if len(parts) > 1 else form, size))
    return found


def _across(seen: Tensor) -> Tensor:
    return torch.eye(seen.shape[1], dtype=torch.float64) - torch.linalg.pinv(seen) @ seen


def blind(config: Any, velocities: int) -> Tensor | None:
    """The projection (m, m) onto features (position, then velocities) that networks may see; None: all."""
    moved = directions(config.translations, config.angles)
    if not moved:
        return None
    columns = [[] for _ in moved]
    for i, (angle, scale) in enumerate(zip(config.angles, config.scale, strict=True)):
        for column, d in zip(columns, moved, strict=True):
            column += [d[i], d[i]] if angle else [d[i] / scale]
    rows = []
    for column, d in zip(columns, moved, strict=True):
        lone = any(w and a for w, a in zip(d, config.angles, strict=True))
        at = [i for i, x in enumerate(column) if x]
        rows += [[float(i == j) for j in range(len(column))] for i in at] if lone else [column]
    seen = torch.tensor(rows, dtype=torch.float64)
    seen = torch.cat([seen, seen.new_zeros(len(seen), velocities)], 1)
    return _across(seen)
