"""Names and formulas of affine point symmetries (`herglotz.theory.symmetries`): a generator and its J as text."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from herglotz.least_squares import least_squares

# An entry below this share of the largest one counts as 0: printed numbers have four digits.
MIN_RELATIVE_ENTRY = 1e-6


def name_of(A: Tensor, b: Tensor, a: float, coordinates: Sequence[str]) -> str:
    """Words for ξ(q) = A q + b with s ↦ s + ε a s, such as "translation along x"."""
    A, b = _clean(A, b)
    keeps_s, fixed = abs(a) <= MIN_RELATIVE_ENTRY, _fixed_point(A, b)
    if keeps_s and not bool(A.any()):
        return _translation(b, coordinates)
    if keeps_s and fixed is not None and (plane := _plane(A)):
        i, j = plane
        kind = "rotation" if bool(torch.allclose(A, -A.mT)) else "elliptic rotation"
        return f"{kind} in the plane ({coordinates[i]}, {coordinates[j]}){_around(fixed)}"
    eye = torch.eye(len(b), dtype=A.dtype)
    if fixed is not None and abs(a - 2) <= 1e-6 and bool(torch.allclose(A, eye)):
        return f"scaling of q, and of s by its square{_around(fixed)}"
    parts = [f"{name}′ = {_sum([*zip(A[i].tolist(), coordinates, strict=True), (float(b[i]), '')])}"
             for i, name in enumerate(coordinates) if bool(A[i].any()) or b[i] != 0]  # fmt: skip
    return f"affine motion {', '.join(parts if keeps_s else [*parts, f's′ = {a:.4g} s'])}"


def _translation(b: Tensor, coordinates: Sequence[str]) -> str:
    """Words for ξ(q) = b."""
    moved = [name for name, x in zip(coordinates, b.tolist(), strict=True) if x]
    if len(moved) == 1:
        return f"translation along {moved[0]}"
    if len(set(b[b != 0].tolist())) == 1:
        return f"translation of {', '.join(moved[:-1])} and {moved[-1]} together"
    return f"translation along ({', '.join(f'{x:.4g}' for x in b.tolist())})"


def _plane(A: Tensor) -> list[int]:
    """The two coordinates that A rotates, on circles or ellipses; empty if A is no such rotation."""
    turned = (A != 0).nonzero().tolist()
    return turned[0] if len(turned) == 2 and bool((A * A.mT).sum() < 0) else []


def formula(
    generator: Sequence[Tensor], boundary: Sequence[Tensor], coordinates: Sequence[str], drift: float = 0.0
) -> str:
    """J = p·(A q + b) − a s − χ(q) as text, from (A, b, a) and the (k, w, B) of χ.

    Entries below ten times the drift, relative to the largest, are left out: the error of a learned χ has that size.
    """
    (A, b, a), (k, w, B) = generator, boundary
    terms = []
    for i, name in enumerate(coordinates):
        terms.append((float(b[i]), f"p_{name}"))
        terms += [(float(A[i, j]), f"{other} p_{name}") for j, other in enumerate(coordinates)]
    terms.append((-float(a), "s"))
    chi = [(-float(w[i]), name) for i, name in enumerate(coordinates)]
    for i, name in enumerate(coordinates):
        for j in range(i, len(coordinates)):
            text = f"{name}²" if i == j else f"{name} {coordinates[j]}"
            chi.append((-float(B[i, j]) * (0.5 if i == j else 1.0), text))
    return _sum([*terms, *chi, (-float(k), "")], min(max(MIN_RELATIVE_ENTRY, 10 * drift), 0.1))


def _sum(terms: list[tuple[float, str]], small: float = MIN_RELATIVE_ENTRY) -> str:
    """The text `2 x − y + 3` for [(2, "x"), (−1, "y"), (3, "")]."""
    least = small * max(abs(x) for x, _ in terms)
    terms = [(x, symbol) for x, symbol in terms if abs(x) > least]
    first = next((i for i, (x, _) in enumerate(terms) if x > 0), 0)
    text = ""
    for x, symbol in [*terms[first : first + 1], *terms[:first], *terms[first + 1 :]]:
        number = f"{abs(x):.4g}" if abs(abs(x) - 1) > MIN_RELATIVE_ENTRY or not symbol else ""
        sign = " − " if x < 0 else " + "
        text += (sign if text else sign.strip().replace("+", "")) + " ".join(y for y in (number, symbol) if y)
    return text or "0"


def _clean(A: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """A and b with 0 for entries below `MIN_RELATIVE_ENTRY` of the largest one."""
    least = MIN_RELATIVE_ENTRY * max(float(A.abs().max()), float(b.abs().max()))
    return torch.where(A.abs() > least, A, 0.0), torch.where(b.abs() > least, b, 0.0)


def _fixed_point(A: Tensor, b: Tensor) -> Tensor | None:
    """The point q with A q + b = 0 nearest to 0, or None."""
    point = least_squares(A, -b[:, None])[:, 0]
    return point if float((A @ point + b).abs().max()) <= MIN_RELATIVE_ENTRY * max(1.0, float(b.abs().max())) else None


def _around(point: Tensor) -> str:
    """The words " about (x, y)"; "" for the origin."""
    if float(point.abs().max()) <= MIN_RELATIVE_ENTRY:
        return ""
    return f" about ({', '.join(f'{x:.4g}' for x in point.tolist())})"
