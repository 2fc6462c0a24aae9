"""Linear combinations of named features, and the potential of named features."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor, nn

from herglotz.models.config import ModelConfig
from herglotz.models.features import Feature, Product, expand, parse
from herglotz.models.jet import Jet, pairs

# Functions of a linear form w·q; "radius" is a function of r².
RIDGES = ("cos", "sin", "power", "signed")


class Combination(nn.Module):
    """Σ_g θ_g φ_g with θ learned from 0, plus the known features with their own numbers, at a first mass of 1."""

    def __init__(self, features: Sequence[Feature], known: Sequence[Feature], dof: int):
        super().__init__()
        grouped = [(p, g) for g, feature in enumerate([*features, *known]) for p in feature]
        names = [*RIDGES, "radius"]
        grouped.sort(key=lambda pair: names.index(pair[0].function))
        self.products: list[Product] = [p for p, _ in grouped]
        self.counts = [sum(p.function == f for p in self.products) for f in names]
        self.ridges = sum(self.counts[: len(RIDGES)])
        self.dof, self.learned = dof, len(features)
        self.highest_degree = max((p.degree for p in self.products), default=0)
        self.highest = max((p.power for p in self.products[: self.ridges]), default=0)
        self.coefficient = nn.Parameter(torch.zeros(len(features), dtype=torch.float64))
        form = torch.tensor([p.form for p in self.products[: self.ridges]], dtype=torch.float64).reshape(-1, dof)
        arm = torch.tensor([p.arm or (0.0,) * dof for p in self.products[: self.ridges]], dtype=torch.float64)
        arm = arm.reshape(-1, dof)
        numbers = {
            "factor": torch.tensor([p.factor for p in self.products], dtype=torch.float64),
            "phase": torch.tensor([p.phase for p in self.products[: self.ridges]], dtype=torch.float64),
            "arm": arm,  # (ridges, n) a
            "degree": torch.tensor([float(p.degree) for p in self.products[: self.ridges]], dtype=torch.float64),
            **of_forms(form, arm),
            "power": torch.tensor([float(p.power) for p in self.products], dtype=torch.float64),
            "group": torch.tensor([g for _, g in grouped], dtype=torch.long),
        }
        for name, value in numbers.items():
            self.register_buffer(name, value, persistent=False)
        self.factor: Tensor
        self.form: Tensor
        self.phase: Tensor
        self.shifted = any(p.phase for p in self.products)
        self.outer: Tensor
        self.arm: Tensor
        self.degree: Tensor
        self.arms: Tensor
        self.outer_arm: Tensor
        self.power: Tensor
        self.group: Tensor

    def weights(self) -> Tensor:
        """Return the coefficient of each product, (A,)."""
        if not self.learned:
            return self.factor
        known = torch.ones_like(self.coefficient[:1])
        return torch.cat([self.coefficient, known])[self.group.clamp_max(self.learned)] * self.factor

    def forms(self, q: Tensor) -> Tensor:
        """Return w·q + phase, (..., ridges)."""
        x = q @ self.form.T
        return x + self.phase if self.shifted else x

    def ridge(self, x: Tensor, k: int) -> Tensor:
        """Return the k-th derivative of the functions of w·q at x = w·q + phase, (..., ridges)."""
        functions = (
            lambda y: _wave(y, k), lambda y: _wave(y, k + 3), lambda y: self._powers(y, k),
            lambda y: y.sign() * self._powers(y, k, "signed"),
        )  # fmt: skip
        parts = zip(functions, x.split(self.counts[: len(RIDGES)], -1), strict=True)
        found = [function(part) for function, part in parts if part.shape[-1]]
        return found[0] if len(found) == 1 else torch.cat(found, -1)

    def _powers(self, x: Tensor, k: int, function: str = "power") -> Tensor:
        """Return the k-th derivative of the powers of kind `function`, without a sign."""
        return _power(x, self.power.split(self.counts)[RIDGES.index(function)], self.highest, k)

    def lever(self, q: Tensor, k: int) -> Tensor:
        """Return the k-th derivative of (a·q)^degree, (..., ridges)."""
        return _power(q @ self.arm.T, self.degree, self.highest_degree, k)

    def value(self, q: Tensor, f: Tensor) -> Tensor:
        """Return f (a·q)^degree, for f (..., ridges) of the ridges: what they are times their lever arms."""
        return f * self.lever(q, 0) if self.highest_degree else f

    def slope(self, q: Tensor, f: Tensor, f1: Tensor) -> Tensor:
        """Return the gradients by q, (..., n), of the sums of f (a·q)^degree over the ridges, f1 being f′."""
        if not self.highest_degree:
            return f1 @ self.form
        return (f1 * self.lever(q, 0)) @ self.form + (f * self.lever(q, 1)) @ self.arm

    def bend(self, q: Tensor, f: Tensor, f1: Tensor, f2: Tensor) -> Tensor:
        """Return the Hessians by q, rows i ≤ j (..., n(n+1)/2), of these sums."""
        if not self.highest_degree:
            return f2 @ self.outer
        a = [self.lever(q, k) for k in range(3)]
        return (f2 * a[0]) @ self.outer + (f1 * a[1]) @ self.arms + (f * a[2]) @ self.outer_arm

    def radial(self, square: Tensor, k: int) -> Tensor:
        """Return the k-th derivative of the radial functions by r², (..., number of radial functions)."""
        exponent = self.power.split(self.counts)[-1] / 2
        return _front(exponent, k) * square[..., None].pow(exponent - k)


def of_forms(form: Tensor, arm: Tensor) -> dict[str, Tensor]:
    """Return the buffers of a `Combination` that follow from its forms w and arms a, (ridges, n) each."""
    i, j = pairs(form.shape[-1], form.device)
    return {
        "form": form,
        "outer": form[:, i] * form[:, j],  # (ridges, n(n+1)/2) rows of w wᵀ
        "arms": form[:, i] * arm[:, j] + arm[:, i] * form[:, j],  # (ridges, n(n+1)/2) rows of w aᵀ + a wᵀ
        "outer_arm": arm[:, i] * arm[:, j],  # (ridges, n(n+1)/2) rows of a aᵀ
    }


class FeaturePotential(nn.Module):
    """V = Σ_g θ_g φ_g(q), where every φ is a function of one number, so that no jets are multiplied.

    A ridge f(w·q) has V′ = f′ w and V″ = f″ w wᵀ; f(r²) has V′ = 2 f′ q and V″ = 4 f″ q qᵀ + 2 f′ I.
    """

    def __init__(self, features: Sequence[Feature], known: Sequence[Feature], dof: int):
        super().__init__()
        self.sum = Combination(features, known, dof)

    def forward(self, q: Tensor, order: int, along: Tensor | None = None) -> Jet:
        """Return V as a jet over the n components of q, or V′y for a constant y = `along`, (..., n)."""
        c = self.sum
        ridge, radial = c.weights().split([c.ridges, len(c.products) - c.ridges])
        # Exported files take no tensor without entries.
        parts = [self._of_forms(q, ridge, order, along)] if c.ridges else []
        parts += [self._radial(q, radial, order, along)] if c.ridges < len(c.products) else []
        return reduce(Jet.__add__, parts)

    def value_and_slope(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return V (...) and V′ (..., n), without a jet."""
        c, parts = self.sum, []
        ridge, radial = c.weights().split([c.ridges, len(c.products) - c.ridges])
        if c.ridges:
            x = c.forms(q)
            f, f1 = c.ridge(x, 0), c.ridge(x, 1) * ridge
            parts.append((c.value(q, f) @ ridge, c.slope(q, f * ridge, f1)))
        if c.ridges < len(c.products):
            square = (q * q).sum(-1)
            parts.append((c.radial(square, 0) @ radial, 2 * (c.radial(square, 1) @ radial)[..., None] * q))
        V, slope = (reduce(torch.add, x) for x in zip(*parts, strict=True))
        return V, slope

    def _of_forms(self, q: Tensor, weights: Tensor, order: int, y: Tensor | None) -> Jet:
        """Return the sum of the functions of w·q as a jet, or its derivative along y."""
        c, x, k = self.sum, self.sum.forms(q), 0 if y is None else 1
        if y is not None:
            weights = weights * (y @ c.form.T)
        f = [c.ridge(x, k + j) * weights for j in range(order + 1)]
        rows = [c.value(q, f[0]).sum(-1)[None], c.slope(q, *f[:2]).movedim(-1, 0)]
        if order == 2:
            rows.append(c.bend(q, *f).movedim(-1, 0))
        return Jet(torch.cat(rows), c.dof, order)

    def _radial(self, q: Tensor, weights: Tensor, order: int, y: Tensor | None) -> Jet:
        """Return F(r²) as a jet, or 2F′ q·y where y is given."""
        n, square = self.sum.dof, (q * q).sum(-1)
        F = [self.sum.radial(square, k) @ weights for k in range(order + 1 + (y is not None))]
        i, j = pairs(n, q.device)
        same = (i == j).to(q.dtype)
        qi, qj = q[..., i], q[..., j]
        hessian = lambda F1, F2: 4 * F2[..., None] * qi * qj + 2 * F1[..., None] * same  # noqa: E731
        if y is None:
            rows = [F[0][None], (2 * F[1][..., None] * q).movedim(-1, 0)]
            return Jet(torch.cat([*rows, hessian(F[1], F[2]).movedim(-1, 0)] if order == 2 else rows), n, order)
        qy = (q * y).sum(-1)
        rows = [(2 * F[1] * qy)[None], (4 * (F[2] * qy)[..., None] * q + 2 * F[1][..., None] * y).movedim(-1, 0)]
        if order == 2:
            mixed = 4 * F[2][..., None] * (qi * y[..., j] + qj * y[..., i])
            rows.append((2 * qy[..., None] * hessian(F[2], F[3]) + mixed).movedim(-1, 0))
        return Jet(torch.cat(rows), n, order)


def baseline_features(
    angles: Sequence[bool], stiffness: Sequence[float], tilt: Sequence[float]
) -> tuple[list[str], list[float]]:
    """Return the baseline's k (1 − cos q) + b sin q, or k q²/2 + b q, as features with their coefficients."""
    names, values = [], []
    for i, (angle, k, b) in enumerate(zip(angles, stiffness, tilt, strict=True), 1):
        names += [f"cos(q{i})", f"sin(q{i})"] if angle else [f"q{i}^2", f"q{i}"]
        values += [-k if angle else k / 2, b]
    return names, values


def baseline_is_named(config: Any) -> bool:
    """Whether the first 2n features of a model are its baseline, as at order 4, where features alone make V."""
    return config.order == 4 and not config.alike and not config.translations


def named_potential(config: ModelConfig) -> FeaturePotential | None:
    """Return the potential of a model's named features, at order 4 with its baseline; None without features."""
    own, values = [], []
    if baseline_is_named(config):
        own, values = baseline_features(config.angles, config.stiffness, config.tilt)
    learned = sorted_features((*own, *(x for x in config.features if x not in own)), config.angles)[0]
    known = sorted_features(config.known, config.angles)[0]
    if not learned and not known:
        return None
    potential = FeaturePotential(learned, known, config.dof)
    potential.sum.coefficient.data[: len(values)] = torch.tensor(values, dtype=torch.float64)
    return potential


def sorted_features(names: Sequence[str], angles: Sequence[bool]) -> tuple[list[Feature], list[Feature]]:
    """Parse names and libraries into the features of the potential and of the kinetic term."""
    features = [parse(text, angles) for text in expand(names, angles)]
    return [f for f in features if not f[0].velocities], [f for f in features if f[0].velocities]


def _wave(x: Tensor, k: int) -> Tensor:
    """Return the k-th derivative of cos; k + 3 gives the k-th derivative of sin."""
    wave = x.sin() if k % 2 else x.cos()
    return -wave if k % 4 in (1, 2) else wave


def _power(x: Tensor, exponent: Tensor, highest: int, k: int) -> Tensor:
    """Return the k-th derivative of x to whole powers, of which the largest is `highest`."""
    rest, product = exponent - k, torch.ones_like(x)
    # The forward-mode derivative of `pow` takes the logarithm of negative numbers.
    for j in range(highest - k):
        product = product * torch.where(rest > j, x, 1.0)
    return _front(exponent, k) * product


def _front(exponent: Tensor, k: int) -> Tensor:
    """Return the factor p (p − 1) … of the k-th derivative of a power p."""
    front = torch.ones_like(exponent)
    for j in range(k):
        front = front * (exponent - j)
    return front
