"""Translations under which a model is invariant by construction.

A translation q ↦ q + ε d is named by the linear form with the numbers d, "q1 + q2" or "q1 - 0.5 q2". Networks read
their features through the projection on the complement of d, named features must be invariant under d, and the
baseline's springs act on the projected position. L_d is then invariant, so that J = p·d obeys J_{k+1} = c_k J_k to
rounding at every step. `herglotz.theory.symmetries` finds the translations of a model without constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.models.features import expand, parse

# The pseudo-inverse rounds numbers of size 1 by less than this.
ROUNDING = 1e-9
# Every message about a translation that cannot be read ends with this remedy.
HOW = "name what moves together, as 'q1 + q2'"


def directions(texts: Sequence[str], angles: Sequence[bool]) -> list[tuple[float, ...]]:
    """The direction d of every translation, n numbers each.

    Raise InputError if a text is no linear form of coordinates, or moves an angle together with another coordinate.
    """
    found = []
    for text in texts:
        # The grammar allows angles in the form of a sine.
        try:
            d = parse(f"sin({text})", angles)[0].form
        except InputError as error:
            raise InputError(f"translation '{text}': {str(error).split(': ', 1)[-1]}; {HOW}") from None
        if not any(d):
            raise InputError(f"translation '{text}' is no direction; {HOW}")
        if any(w and a for w, a in zip(d, angles, strict=True)) and sum(map(bool, d)) > 1:
            raise InputError(
                f"translation '{text}': an angle is translated alone; name features of differences instead"
            )
        found.append(d)
    return found


def check_translations(config: Any) -> None:
    """Raise `InputError` if a term of the model is not invariant under the model's translations."""
    moved = directions(config.translations, config.angles)
    if not moved:
        return
    not_invariant = {
        "a mass that depends on position": config.mass_width > 0,
        "the level full": config.level == "full",
        "terms by name": bool(config.terms),
        "drag that depends on position": any("q" in text for text in config.drag),
    }
    for what in (name for name, present in not_invariant.items() if present):
        raise InputError(f"translations: not possible with {what}; leave one of the two out")
    for text in expand((*config.features, *config.known), config.angles):
        if not unchanged(text, config.angles, moved):
            raise InputError(f"feature '{text}': changes under the translation; name one of differences")


def unchanged(text: str, angles: Sequence[bool], moved: Sequence[tuple[float, ...]]) -> bool:
    """Whether a feature is invariant along all of the directions."""
    products = parse(text, angles)
    forms = [form for p in products for form in (p.form, p.arm) if any(form)]
    return not any(p.function == "radius" and p.power for p in products) and not any(
        abs(sum(map(float.__mul__, form, d))) > ROUNDING for form in forms for d in moved
    )


def differences(angles: Sequence[bool], moved: Sequence[tuple[float, ...]]) -> list[str]:
    """Forms of two moved lengths, "(q1 - q2)", that are invariant along the first direction in which both move."""
    found = []
    for (i, a), (j, b) in combinations(enumerate(zip(*moved, strict=True)), 2):
        ratio = next((y / x for x, y in zip(a, b, strict=True) if x and y), 0.0)
        if ratio and not (angles[i] or angles[j]):
            first = f"q{i + 1}" if abs(ratio) == 1 else f"{abs(ratio)!r}q{i + 1}"
            found.append(f"({first} - q{j + 1})" if ratio > 0 else f"({first} + q{j + 1})")
    return found


def projection(translations: Sequence[str], angles: Sequence[bool]) -> Tensor | None:
    """The projection (n, n) on the orthogonal complement of the translations' directions; None without translations."""
    moved = directions(translations, angles)
    return _complement(torch.tensor(moved, dtype=torch.float64)) if moved else None


def across_in_words(P: Tensor, names: Sequence[str]) -> list[tuple[str, float]]:
    """The rows of a projection as text "(x − y)" with the factor in front; the text of a zero row is ""."""
    found = []
    for row in P.tolist():
        factor = next((w for w in row if w), 1.0)
        parts = [(w / factor, name) for w, name in zip(row, names, strict=True) if w]
        texts = [
            f"{'−' if w < 0 else '+'} {'' if abs(abs(w) - 1) < ROUNDING else f'{abs(w):.10g} '}{name}"
            for w, name in parts
        ]
        form = " ".join(texts).removeprefix("+ ")
        found.append((f"({form})" if len(parts) > 1 else form, factor))
    return found


def _complement(rows: Tensor) -> Tensor:
    """The projection on the orthogonal complement of the rows."""
    return torch.eye(rows.shape[1], dtype=torch.float64) - torch.linalg.pinv(rows) @ rows


def blind(config: Any, velocities: int) -> Tensor | None:
    """The projection (m, m) of a network's features on those that the translations do not change.

    The features are those of the position, then the velocities, which no translation changes. None without
    translations.
    """
    moved = directions(config.translations, config.angles)
    if not moved:
        return None
    rows = []
    for d in moved:
        coordinates = list(zip(d, config.angles, config.scale, strict=True))
        row = [x for w, angle, scale in coordinates for x in ([w, w] if angle else [w / scale])]
        # The sine and the cosine of a moved angle are both removed; of moved lengths, their common direction.
        angle = any(w and a for w, a, _ in coordinates)
        at = [i for i, x in enumerate(row) if x]
        rows += [[float(i == j) for j in range(len(row))] for i in at] if angle else [row]
    removed = torch.tensor(rows, dtype=torch.float64)
    return _complement(torch.cat([removed, removed.new_zeros(len(removed), velocities)], 1))
