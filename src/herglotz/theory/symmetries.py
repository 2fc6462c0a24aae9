"""Beyond the paper: the affine point symmetries of a discrete Lagrangian as a null space, and their quantities J.

A generator ξ(q) = A q + b moves positions, and the action by s ↦ s + ε (a s + χ(q)), χ(q) = k + w·q + ½ q·B q.
The generator is a symmetry of L_d where

    D1·ξ(q0) + D2·ξ(q1) + c (a s0 + χ(q0)) − (a s1 + χ(q1)) = 0,        s1 = s0 + L_d,

at every (q0, q1, s0) of an open set. χ = a = 0 is invariance. χ ≠ 0 is invariance up to a boundary term; examples are
translations in a magnetic field, and along gravity with damping (χ = −mg/γ). a = 2 and A = 1 scale the solutions of a
linear equation. By −D1 = c p_k and D2 = p_{k+1} the left-hand side is J_{k+1} − c_k J_k for

    J(q, p, s) = p·ξ(q) − a s − χ(q),

so that J_{k+1} = c_k J_k is the condition of symmetry itself (`herglotz.theory.noether`), and J_k = σ_k J_0. With
forces the condition on L_d is the same, and J changes in addition by F⁻·ξ(q0) + F⁺·ξ(q1).

The condition is linear in (A, b, a, k, w, B). The defects are summed along motions of K steps, J_k − σ_k J_0: the
defect of a generator that is no symmetry grows with the duration and not with h. Projection gives the best χ of every
ξ. A singular value is then the **drift**: the RMS defect over the RMS of the part of p·ξ − a s outside all boundary
terms. The drift has no unit, and s ↦ s + b(q) with a quadratic b does not change the drift. A generator is a symmetry
if its drift is at most `precision`: the rounding of a known L_d, or the relative error of the free run of a learned
L_d, whose J is then as precise as its positions. Positions alone determine L_d up to a gauge (trap 3): a fitted network
may hide a symmetry behind a boundary term that is not quadratic; named terms do not.

Sources: E. Lishkova, P. Scherer, S. Ridderbusch, M. Jamnik, P. Liò, S. Ober-Blöbaum, C. Offen, Discrete Lagrangian
neural networks with automatic symmetry discovery, IFAC-PapersOnLine 56 (2023) 3203; contact Noether theorem: section 1
of `docs/mathematics.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.partials import DiscreteLagrangian, partials
from herglotz.stepping import State, Status, Stepper
from herglotz.stepping.state import check_batch
from herglotz.theory.symmetry_words import formula, name_of

# Largest drift of a symmetry of a known L_d. Symmetries leave 1e-16 to 1e-13 (float32: 1e-6), and a symmetry broken by
# 1e-7 of the force leaves more (`tests/unit/theory/test_symmetries.py`).
PRECISION = {torch.float64: 1e-9, torch.float32: 1e-4}
# The motions do not determine a generator whose p·ξ − a s is below this share of the largest: in float64 that is half
# of the digits.
MIN_RELATIVE_SIZE = 1e-7
# A boundary term whose defect is below this share of its terms is trivial, such as a constant where c = 1.
MIN_RELATIVE_DEFECT = 1e-12
# Entries within this share of the largest entry of a multiple of ½ are replaced by the multiple if the drift allows.
SNAP_DISTANCE = 0.05


@dataclass(frozen=True, repr=False)
class Symmetries:
    """r generators ξ(q) = A q + b, s ↦ s + ε (a s + χ), in the order translations, rotations and others.

    χ(q) = k + w·q + ½ q·B q. The basis of the algebra is reduced to entries 0 and 1 as far as possible. `drift` is the
    RMS of J_k − σ_k J_0 over the RMS of p·ξ − a s without boundary terms, `spectrum` the drifts of all m directions in
    ascending order, `precision` the largest drift of a symmetry, and `unseen` the number of directions that the motions
    do not determine. `print` names each symmetry, with J; `len` is r.
    """

    A: Tensor  # (r, n, n)
    b: Tensor  # (r, n)
    a: Tensor  # (r)
    k: Tensor  # (r)
    w: Tensor  # (r, n)
    B: Tensor  # (r, n, n)
    drift: Tensor  # (r)
    spectrum: Tensor  # (m)
    precision: float
    unseen: int
    coordinates: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.a)

    @property
    def gap(self) -> float:
        """The drift of the best direction that is no symmetry, over `precision`; infinite if all are symmetries."""
        rest = self.spectrum[len(self) :]
        return float(rest[0]) / self.precision if len(rest) else float("inf")

    def generator(self, q: Tensor) -> Tensor:
        """ξ(q) of every symmetry, (..., n) → (..., r, n)."""
        return (self.A.to(q) @ q[..., None, :, None])[..., 0] + self.b.to(q)

    def shift(self, q: Tensor, s: Tensor) -> Tensor:
        """The change of s by each generator: a s + χ(q), (..., n) and (...) → (..., r)."""
        bent = (q[..., None, None, :] @ self.B.to(q) @ q[..., None, :, None])[..., 0, 0]
        return self.a.to(s) * s[..., None] + self.k.to(q) + q @ self.w.to(q).mT + 0.5 * bent

    def momentum(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """J = p·ξ(q) − a s − χ(q) of every symmetry, (..., r): J_{k+1} = c_k J_k."""
        return (p[..., None, :] * self.generator(q)).sum(-1) - self.shift(q, s)

    @property
    def names(self) -> tuple[str, ...]:
        """Every symmetry in words, for example "translation along x" or "rotation in the plane (x, y)"."""
        return tuple(name_of(self.A[i], self.b[i], float(self.a[i]), self.coordinates) for i in range(len(self)))

    def to_dict(self) -> dict[str, object]:
        """Plain dictionary for JSON."""
        numbers = {name: getattr(self, name).tolist() for name in ("A", "b", "a", "k", "w", "B", "drift", "spectrum")}
        more = {"names": self.names, "precision": self.precision, "unseen": self.unseen, "gap": self.gap}
        return {**numbers, **more, "coordinates": self.coordinates}

    def __repr__(self) -> str:
        return f"Symmetries({', '.join(self.names) or 'none'})"

    def __str__(self) -> str:
        lines = [f"affine point symmetries: {len(self) or 'none'}"]
        for i, name in enumerate(self.names):
            generator, boundary = (self.A[i], self.b[i], self.a[i]), (self.k[i], self.w[i], self.B[i])
            J = formula(generator, boundary, self.coordinates, float(self.drift[i]))
            lines.append(f"  {name}: J = {J}, drift {float(self.drift[i]):.1e}")
        rest = self.spectrum[len(self) :]
        lines.append(f"  a symmetry keeps J_k = σ_k J_0 within {self.precision:.1e} of p·ξ")
        if len(rest):
            lines.append(f"  the best other direction drifts by {float(rest[0]):.1e}")
        if self.unseen:
            lines.append(f"  {self.unseen} directions are not determined by these motions")
        return "\n".join(lines)


def symmetries(
    L_d: DiscreteLagrangian,
    states: tuple[Tensor, Tensor, Tensor],  # (q, p, s): (B, n), (B, n), (B)
    h: Tensor | float,
    *,
    steps: int = 40,
    precision: float | None = None,
    angles: Sequence[bool] = (),
    coordinates: Sequence[str] = (),
) -> Symmetries:
    """The Lie algebra of affine point symmetries of L_d, and the quantities J with J_{k+1} = c_k J_k.

    L_d may have forces.

    Parameters
    ----------
    states
        Starts of motions that fill an open set; a single motion leaves directions undetermined (`unseen`).
    steps
        Number K of steps of each motion; the motions should be long enough for other generators to show a defect.
    precision
        Largest drift of a symmetry; by default 1e-9, in float32 1e-4.
    angles
        Which coordinates are angles. ξ and χ must not depend on angles, so that they are single-valued.
    coordinates
        Names of the coordinates; by default q1, q2, ….

    Raise InputError if the shapes do not fit, or no motion could be stepped.
    """
    state = check_batch(states)
    n = state.q.shape[-1]
    names = tuple(coordinates) or tuple(f"q{i + 1}" for i in range(n))
    for setting, given in (("angles", angles), ("coordinates", names)):
        if len(given) not in (0, n):
            raise InputError(f"{setting} needs one entry a coordinate ({n}), got {len(given)}")
    straight = [i for i in range(n) if not (angles and angles[i])]
    most = PRECISION.get(state.q.dtype, 1e-4) if precision is None else precision
    return _null_space(_columns(L_d, state, h, steps, straight), most, names)


@dataclass(frozen=True)
class _Columns:
    """One column for each basis generator, A row by row, b, a, and for each boundary term, k, w, B.

    The rows are the R samples of all motions, and the columns functions of q − q̄ and s − s̄. `defect` and `shift` are
    J_k − σ_k J_0 of generators and of boundary terms; `size` is p·ξ − a s without its part in the span of the boundary
    terms, `terms` the RMS of the boundary terms. The columns of A belong to the coordinates `straight`, no angles.
    """

    defect: Tensor  # (R, m)
    size: Tensor  # (R, m)
    shift: Tensor  # (R, m')
    terms: Tensor  # (m')
    centre: Tensor  # (n) q̄
    middle: Tensor  # () s̄
    straight: list[int]

    @property
    def usable(self) -> Tensor:
        """Which boundary terms are not trivial, (m')."""
        return _rms(self.shift) > MIN_RELATIVE_DEFECT * self.terms

    def chi(self, rows: Tensor) -> Tensor:
        """The coefficients χ of boundary terms that minimise the defects of generators, (r, m) → (r, m')."""
        usable = self.usable
        U, S, V = torch.linalg.svd(self.shift[:, usable] / self.terms[usable], full_matrices=False)
        above_rounding = MIN_RELATIVE_DEFECT * (S.amax() if len(S) else 1.0) < S
        fitted = (rows @ self.defect.mT) @ (U[:, above_rounding] / S[above_rounding]) @ V[above_rounding]
        chi = rows.new_zeros(len(rows), len(usable))
        chi[:, usable] = -fitted / self.terms[usable]
        return chi

    def drift(self, rows: Tensor) -> Tensor:
        """RMS defect over RMS size, (r)."""
        left = rows @ self.defect.mT + self.chi(rows) @ self.shift.mT
        return _rms(left.mT) / _rms(self.size @ rows.mT)

    def about(self, rows: Tensor, point: Tensor) -> Tensor:
        """The same generators with b at another point: ξ = A (q − q̄) + b = A (q − q̄ − point) + b′."""
        n, wide = len(point), len(point) * len(self.straight)
        A = rows[:, :wide].unflatten(-1, (n, -1))
        moved = rows.clone()
        moved[:, wide : wide + n] += A @ point[self.straight]
        return moved


def _columns(L_d: DiscreteLagrangian, states: State, h: Tensor | float, steps: int, straight: list[int]) -> _Columns:
    """Step the motions, and sum the defects of every basis generator along the motions."""
    with torch.no_grad():
        out = Stepper(L_d).rollout(*states, h=h, steps=steps)
        whole = (out.status == Status.CONVERGED).all(-1)
        if not bool(whole.any()):
            raise InputError(f"no motion could be stepped {steps} times; give other states, a shorter h or fewer steps")
        q, s = out.q[whole], out.s[whole]
        P = partials(L_d, q[:, :-1], q[:, 1:], s[:, :-1], h).map(lambda x: x.double())
        q, s = q.double(), s.double()
    centre, middle = q.mean((0, 1)), s.mean()
    (q0, q1), (s0, s1) = ((x[:, :-1], x[:, 1:]) for x in (q - centre, s - middle))
    chi0, chi1 = _boundary(q0[..., straight]), _boundary(q1[..., straight])
    pair = lambda x, y: (x[..., :, None] * y[..., None, straight]).flatten(-2)  # noqa: E731
    moved = [pair(P.D1, q0) + pair(P.D2, q1), P.D1 + P.D2, (P.c * s0 - s1)[..., None]]
    step = torch.cat([*moved, P.c[..., None] * chi0 - chi1], -1)
    rows = [step[:, 0]]
    # J_{k+1} − σ_{k+1} J_0 = c_k (J_k − σ_k J_0) + the defect of step k.
    for k in range(1, steps):
        rows.append(P.c[:, k, None] * rows[-1] + step[:, k])
    defect = torch.stack(rows, 1).flatten(0, 1)
    size = torch.cat([pair(P.D2, q1), P.D2, -s1[..., None]], -1).flatten(0, 1)
    chi, m = chi1.flatten(0, 1), size.shape[-1]
    # The size leaves out boundary terms, which a gauge adds to p, and the part of s that is due to s_0.
    start = torch.cat([s0[:, :1, None], chi0[:, :1]], -1)
    kept = (P.c.cumprod(-1)[..., None] * start).flatten(0, 1)
    size = torch.cat([_outside_span(chi, size[:, :-1]), _outside_span(torch.cat([chi, kept], -1), size[:, -1:])], -1)
    if len(size) < 2 * defect.shape[-1]:
        raise InputError(f"{len(size)} steps do not determine {defect.shape[-1]} numbers; give more states or steps")
    return _Columns(defect[:, :m], size, defect[:, m:], _rms(chi), centre, middle, straight)


def _outside_span(known: Tensor, columns: Tensor) -> Tensor:
    """The part of the columns outside the span of the known columns."""
    U, S, _ = torch.linalg.svd(known / _rms(known).clamp_min(MIN_RELATIVE_DEFECT), full_matrices=False)
    U = U[:, MIN_RELATIVE_DEFECT * S[0] < S]
    return columns - U @ (U.mT @ columns)


def _null_space(x: _Columns, precision: float, names: tuple[str, ...]) -> Symmetries:
    """The generators whose drift is at most the precision, in a reduced basis: translations, then the others."""
    n, wide = len(x.centre), len(x.centre) * len(x.straight)
    basis, drift, unseen = _below_precision(x, list(range(wide + n + 1)), precision)
    moved, _, _ = _below_precision(x, list(range(wide, wide + n)), precision)
    moved = _reduced(moved, range(wide, wide + n))
    # The other generators: the directions of the basis that are furthest from the translations.
    Q, _ = torch.linalg.qr(x.size @ moved.mT)
    others = x.size @ basis.mT
    _, _, V = torch.linalg.svd(others - Q @ (Q.mT @ others), full_matrices=False)
    # From ξ = A (q − q̄) + b to ξ = A q + b.
    rest = x.about(V[: len(basis) - len(moved)] @ basis, -x.centre)
    rest = _reduced(rest, [wide + n, *range(wide)])
    for row in moved:
        at = int(row.abs().argmax())
        rest = rest - rest[:, at, None] * row / row[at]
    rows = torch.stack([_snapped(x, row, precision) for row in (*moved, *rest)]) if len(basis) else basis
    about = x.about(rows, x.centre)
    chi, A = x.chi(about), rows.new_zeros(len(rows), n, n)
    A[:, :, x.straight] = rows[:, :wide].unflatten(-1, (n, -1))
    k, w, B = _expanded(chi, x, rows[:, -1])
    return Symmetries(A, rows[:, wide:-1], rows[:, -1], k, w, B, x.drift(about), drift, precision, unseen, names)


def _below_precision(x: _Columns, columns: list[int], precision: float) -> tuple[Tensor, Tensor, int]:
    """Generators of some columns with a drift up to the precision, (r, m), all drifts, and the number unseen."""
    size = x.size[:, columns]
    scale = _rms(size)
    scale = torch.where(scale > 0, scale, 1.0)
    _, G, W = torch.linalg.svd(size / scale, full_matrices=False)
    seen = MIN_RELATIVE_SIZE * G.amax() < G
    # Generators of size 1.
    unit = size.new_zeros(int(seen.sum()), x.size.shape[1])
    unit[:, columns] = W[seen] / G[seen, None] * len(size) ** 0.5 / scale
    U, drift, _ = torch.linalg.svd(unit @ x.defect.mT + x.chi(unit) @ x.shift.mT, full_matrices=False)
    drift, U = (drift / len(size) ** 0.5).flip(0), U.flip(1)
    return U[:, : int((drift <= precision).sum())].mT @ unit, drift, int((~seen).sum())


def _reduced(rows: Tensor, columns: Sequence[int]) -> Tensor:
    """The reduced row echelon form, with pivots in the given columns."""
    rows, done, columns = rows.clone(), [], list(columns)
    for _ in rows:
        part = rows[:, columns].abs()
        part = part / part.amax(1, keepdim=True).clamp_min(torch.finfo(rows.dtype).tiny)
        part[done] = 0.0
        i, j = int(part.argmax()) // len(columns), columns[int(part.argmax()) % len(columns)]
        rows[i] = rows[i] / rows[i, j]
        others = torch.arange(len(rows)) != i
        rows[others] -= rows[others, j, None] * rows[i]
        done.append(i)
    return rows[done]


def _snapped(x: _Columns, row: Tensor, precision: float) -> Tensor:
    """The generator with largest entry 1; entries near half-integers are rounded if the drift stays small."""
    n = len(x.centre)
    A, b = row[: -n - 1], row[-n - 1 : -1]
    for lead in (A, b, row[-1:]):
        size = lead.abs().amax() if len(lead) else row.new_zeros(())
        if float(size) > SNAP_DISTANCE * float(row.abs().amax()):
            # The last of equal entries is positive: x p_y − y p_x.
            row = row / lead[int((lead.abs() > 0.999 * size).nonzero()[-1])]
            break
    whole = torch.round(2 * row) / 2
    snapped = torch.where((row - whole).abs() < SNAP_DISTANCE, whole, row)
    return snapped if float(x.drift(x.about(snapped[None], x.centre))) <= precision else row


def _boundary(q: Tensor) -> Tensor:
    """1, q and the products q_i q_j, i ≤ j: (..., k) → (..., 1 + k + k (k + 1)/2)."""
    i, j = torch.triu_indices(q.shape[-1], q.shape[-1])
    return torch.cat([q.new_ones(*q.shape[:-1], 1), q, q[..., i] * q[..., j]], -1)


def _expanded(chi: Tensor, x: _Columns, a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """k, w, B of χ(q) = k + w·q + ½ q·B q, from boundary terms about q̄ and a s about s̄."""
    n, straight = len(x.centre), len(x.straight)
    slope, B = chi.new_zeros(len(chi), n), chi.new_zeros(len(chi), n, n)
    i, j = (torch.tensor(x.straight, dtype=torch.int64)[y] for y in torch.triu_indices(straight, straight))
    slope[:, x.straight] = chi[:, 1 : 1 + straight]
    B[:, i, j] += chi[:, 1 + straight :]
    B[:, j, i] += chi[:, 1 + straight :]
    k = chi[:, 0] - slope @ x.centre + 0.5 * (B @ x.centre) @ x.centre - a * x.middle
    # Where c = 1, a constant is no boundary term but a part of J.
    if not bool(x.usable[0]):
        k = torch.zeros_like(k)
    return k, slope - B @ x.centre, B


def _rms(x: Tensor) -> Tensor:
    """Root mean square of every column."""
    return x.square().mean(0).sqrt()
