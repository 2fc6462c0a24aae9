"""A finished fit, in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.trajectories import GAP
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper
from herglotz.training.baseline import JITTER
from herglotz.training.config import FitConfig
from herglotz.training.predict import Prediction, predict


@dataclass(frozen=True)
class Run:
    """A trained model with everything that is needed to judge it.

    `prediction` is the model's free run at every sample: on the training part from the fitted states, and from the last
    training sample on without another look at the data.
    """

    model: ContactLagrangian
    config: FitConfig
    metrics: dict[str, Any]
    data: Trajectories  # all samples, training and test
    train_lengths: tuple[int, ...]  # leading samples of each trajectory that were trained on
    states: State  # (N, n), (N, n), (N,) at every sample
    h: float  # typical model step
    box: dict[str, list[float]]  # range of q, p, s over the training part: where the model can be trusted
    history: list[dict[str, Any]]  # stage, iteration, cost

    @property
    def prediction(self) -> Tensor:
        """Predicted positions at every sample, (N, n)."""
        return self.states.q

    def states_at_end(self) -> State:
        """Return the state at the last sample of every trajectory, (B, n), (B, n), (B,), to continue from."""
        last = [first + length - 1 for first, length in zip(self.data.offsets, self.data.lengths, strict=True)]
        return State(*(x[last] for x in self.states))

    @property
    def h_range(self) -> tuple[float, float]:
        """The shortest and the longest step that the model was fitted to, with a hair for rounded time stamps.

        A tuned model is made for one step.
        """
        steps, m = self.data.steps().h, self.config.substeps
        fitted = steps[steps <= GAP * m * self.h]
        if m > 1:
            fitted = fitted / (fitted / (JITTER * self.h) - 1e-6).ceil()
        ends = [self.h, *([] if self.setting else (float(fitted.min()), float(fitted.max())))]
        return min(ends) * (1 - 1e-7), max(ends) * (1 + 1e-7)

    @property
    def setting(self) -> dict[str, Any]:
        """Return the setting of a run that `herglotz tune` wrote (artefact, dtype, tol, …); empty for any other run."""
        return (self.metrics.get("tuned") or {}).get("chosen", {})

    @property
    def stepper(self) -> Stepper:
        """The trained time stepper, with Newton's tolerance as tuned."""
        return Stepper(self.model, tol=self.setting.get("tol"))

    def predict(self, data: Trajectories, **settings: Any) -> Prediction:
        """Score the model on another recording; the settings are those of `herglotz.training.predict`."""
        return predict(self, data, **settings)


def box_of(q: Tensor, p: Tensor, s: Tensor) -> dict[str, list[float]]:
    """Lowest and highest q, p and s over a set of states."""
    columns = {"q": q, "p": p, "s": s[:, None]}
    return {
        f"{name}_{end}": (x.amin(0) if end == "low" else x.amax(0)).tolist()
        for name, x in columns.items()
        for end in ("low", "high")
    }
