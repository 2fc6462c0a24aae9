"""How far a recording is missed beside the others, and since when."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from herglotz.data.noise import TAIL
from herglotz.training.problems.robust import FEW, scale_of
from herglotz.training.properties import by_property, inverse

# `reach` of normal residuals over their standard deviation.
NORMAL_REACH = 1.645


class LeftOut(NamedTuple):
    """A recording, counted from 0, what the model of the others misses it by (`reach`), and the scale of their misfit.

    In units of q, over the balance of several kinds of coordinates; `missed` is infinite where a step of the model
    fails. `label` is the recording's (`Trajectories.label`). `since` is the time from which on most samples are
    outliers, None if that is the start. `properties` are inputs that are the same throughout each recording, with a
    value that no other recording has (`herglotz.training.properties`).
    """

    recording: int
    missed: float
    others: float
    label: str
    since: float | None = None
    properties: tuple[str, ...] = ()

    @property
    def reason(self) -> str:
        """The reason of a misfit, with a remedy."""
        times = f"missed {self.missed / self.others:.2g} times as far as the others"
        far = f"is {times if math.isfinite(self.missed) else 'not followed'}{from_then_on(self.since)}"
        what = f"{self.label[:1].upper()}{self.label[1:]}, counted from 0, {far}, and"
        if self.properties:
            return f"{what} {by_property(self.properties)}. Try {inverse(self.properties)}"
        return f"{what} may be of something else. Try the fit without it"

    @property
    def stands_out(self) -> bool:
        """Whether the recording is an outlier of the others."""
        return self.missed > TAIL * self.others

    def as_dict(self) -> dict[str, Any]:
        """The entries of metrics.json, which has no infinite numbers: None if a step of the model fails."""
        return self._asdict() | {"missed": self.missed if math.isfinite(self.missed) else None}


def from_then_on(since: float | None) -> str:
    """The words for a recording that is missed from a time on; "" for one that is missed from its start."""
    return "" if since is None else f" from t = {since:.4g} on"


def reach(missed: Tensor) -> float:
    """The misfit that no more than a tenth (`FEW`) of the numbers exceed: more outliers are no single samples."""
    size = missed.abs().flatten()
    return float(size.kthvalue(len(size) - int(FEW * len(size))).values) if len(size) else 0.0


def since(missed: Tensor, t: Tensor, scale: float) -> float | None:
    """The time (of t, (N,)) from which on most rows of `missed` (N, n) are outliers of this scale, few being before.

    None if there is no such time, or no more than a tenth of the samples come before it.
    """
    out = (missed.abs() > TAIL * scale).any(-1).double()
    if not bool(out.any()):
        return None
    first = int((out - 0.5).flip(0).cumsum(0).flip(0).argmax())
    later, length = float(out[first:].sum()), len(out) - first
    return float(t[first]) if first > FEW * len(out) and 2 * later > max(length, float(out.sum())) else None


def scale_of_all(missed: Sequence[Tensor], least: float) -> float:
    """The scale of the misfit of several recordings, at least `least`."""
    return max(scale_of(torch.cat([own.flatten() for own in missed])), least)


def beside(recording: int, missed: Sequence[Tensor], t: Sequence[Tensor], least: float, label: str) -> LeftOut:
    """A recording beside all others: misfits (N, n) at the times t (N,) of each; errors below `least` are none."""
    own, others = missed[recording], scale_of_all([*missed[:recording], *missed[recording + 1 :]], least)
    return LeftOut(recording, reach(own), others, label, since(own, t[recording], others))
