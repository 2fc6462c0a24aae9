"""Velocities and accelerations of noisy recordings: a polynomial in time through a window around each sample.

The width and the degree minimise the error of the accelerations: noise asks for wide windows, fast motion for narrow
windows. A fit starts from these velocities and accelerations, and does not end with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from herglotz.data.trajectories import Trajectories
from herglotz.data.windows import Triples, powers, pseudo_inverses, rounding

# Even: at the middle of a window an odd power adds nothing to position and acceleration.
DEGREES = (4, 6)
# Samples of a window: odd numbers, each about √2 times the number before.
WIDTHS = (7, 9, 11, 15, 21, 29, 41, 57, 81, 113, 161)
# A squared residual above so many times the least is motion that the polynomials miss.
MAX_RESIDUAL_RATIO = 1.2
# Step of `smooth_triples` over a window's half width: the error of order 2 of so short a step does not count.
SHORT_STEP = 0.02
# Windows by which width and degree are chosen: more do not change the choice.
MAX_WINDOWS = 2000
# Windows that are computed at once, so that memory does not grow with their width.
WINDOWS_AT_ONCE = 2**15


@dataclass(frozen=True)
class LocalPolynomials:
    """The polynomial of each sample, in x = (t − t_k) / half.

    `half` is half the time that the window spans; a window is `centred` if as many samples are before t_k as after.
    """

    width: int
    coefficients: Tensor  # (N, degree + 1, n)
    half: Tensor  # (N,)
    centred: Tensor  # (N,) bool
    start: Tensor  # (N,) first sample of the window

    def at(self, x: Tensor | float) -> Tensor:
        """Positions at x of every window, (N, n)."""
        x = torch.as_tensor(x, dtype=self.half.dtype).expand_as(self.half)
        powers = torch.stack([x**k for k in range(self.coefficients.shape[1])], -1)
        return (powers[..., None] * self.coefficients).sum(1)


def slopes(data: Trajectories, x: Tensor) -> Tensor:
    """ẋ at every sample, (N, …), by parabolas through x (N, …) and its neighbours in the same recording."""
    parts = zip(x.split(data.lengths), data.t.split(data.lengths), strict=True)
    return torch.cat([torch.gradient(own, spacing=(t.contiguous(),), dim=0)[0] for own, t in parts])


def local_polynomials(data: Trajectories) -> LocalPolynomials | None:
    """The local polynomials of the best width and degree; None if a trajectory has fewer than seven samples."""
    if (best := _best_window(data.t, data.q, data.lengths)) is None:
        return None
    width, degree = best
    start, sample, each = _starts(data, width), torch.arange(data.samples), torch.arange(width)
    halves, coefficients = [], []
    for own, first in zip(sample.split(WINDOWS_AT_ONCE), start.split(WINDOWS_AT_ONCE), strict=True):
        rows = first[:, None] + each
        half, x = _times(data, rows, own)
        halves.append(half)
        coefficients.append(pseudo_inverses(x, degree, rounding(data.t[rows], half)) @ data.q[rows].double())
    return LocalPolynomials(width, torch.cat(coefficients), torch.cat(halves), start + width // 2 == sample, start)


# A search asks again for the same positions with other inputs. A tensor is the same only if the object is.
@lru_cache(maxsize=2)
def _best_window(t: Tensor, q: Tensor, lengths: tuple[int, ...]) -> tuple[int, int] | None:
    """The best width and degree; None if a trajectory has fewer than seven samples."""
    data, tried = Trajectories.of(t, q, lengths), []
    for width in WIDTHS:
        if width > max(7, min(lengths) // 2) or width > min(lengths):
            break
        for degree in DEGREES:
            if width >= degree + 3:
                tried.append((width, degree, *_quality(data, width, degree)))
    if not tried:
        return None
    noise = min(left for _, _, left, _ in tried)
    fair = [x for x in tried if x[2] <= MAX_RESIDUAL_RATIO * noise]
    # A residual beyond the noise keeps its sign over a window, and enters the acceleration whole; noise averages out.
    return min(fair, key=lambda x: (noise + x[0] * (x[2] - noise)) * x[3])[:2]


def smoothed(data: Trajectories, local: LocalPolynomials | None = None) -> Trajectories:
    """The recordings with positions on these local polynomials, or on their own; unchanged if too short for any."""
    local = local or local_polynomials(data)
    return data if local is None else replace(data, q=local.at(0.0).to(data.q))


def smooth_triples(data: Trajectories, local: LocalPolynomials) -> tuple[Triples, Tensor | None]:
    """Three positions on each polynomial, a short time apart, and the inputs (T, m) averaged over its window."""
    rows = local.centred.nonzero()[:, 0]
    q0, q1, q2 = (local.at(x)[rows] for x in (-SHORT_STEP, 0.0, SHORT_STEP))
    h = SHORT_STEP * local.half[rows]
    u = None
    if data.u is not None:
        window = local.start[rows, None] + torch.arange(local.width)
        t = data.t[window].double()
        middle = (t[:, 1:] + t[:, :-1]) / 2 - data.t[rows].double()[:, None]
        weight = (1 - (middle / local.half[rows][:, None]).square()).clamp_min(0).square() * t.diff(dim=1)
        u = (weight[..., None] * data.u[window[:, :-1]].double()).sum(1) / weight.sum(1, keepdim=True)
        u = u.to(data.q)
    q0, q1, q2, h = (x.to(data.q) for x in (q0, q1, q2, h))
    return Triples(q0, q1, q2, h, h, rows), u


def _quality(data: Trajectories, width: int, degree: int) -> tuple[float, float]:
    """Mean squared residual per degree of freedom, and the squared factor of the noise in the acceleration."""
    # Samples with a window around them.
    ends = [
        torch.arange(first, first + length)[width // 2 : length - width // 2]
        for first, length in zip(data.offsets, data.lengths, strict=True)
    ]
    middle = torch.cat(ends)
    middle = middle[:: -(-len(middle) // MAX_WINDOWS)]
    rows = middle[:, None] + torch.arange(width) - width // 2
    half, x = _times(data, rows, middle)
    q = data.q[rows].double()
    inverse = pseudo_inverses(x, degree, rounding(data.t[rows], half))
    left = (q - powers(x[: len(inverse)], degree) @ (inverse @ q)).square().mean() * width / (width - degree - 1)
    gain = (2 * inverse[:, 2] / half[:, None].square()).square().sum(1).mean()
    return float(left), float(gain)


def _starts(data: Trajectories, width: int) -> Tensor:
    """The first sample (N,) of the window around each sample, which is shifted inwards at the ends of a trajectory."""
    return torch.cat([
        first + (torch.arange(length) - width // 2).clamp(0, length - width)
        for first, length in zip(data.offsets, data.lengths, strict=True)
    ])  # fmt: skip


def _times(data: Trajectories, rows: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
    """Half the span of the windows `rows` (K, width), and their times around those of the samples `own`, over that."""
    t = data.t[rows].double()
    half = (t[:, -1] - t[:, 0]) / 2
    return half, (t - data.t[own].double()[:, None]) / half[:, None]
