"""`HerglotzRegressor`: a fit behind scikit-learn's interface. Extra: `herglotz[sklearn]`.

>>> from herglotz.regressor import HerglotzRegressor
>>> model = HerglotzRegressor().fit(t[:300], q[:300])
>>> model.predict(t[300:])  # positions at later times
>>> model.score(t[300:], q[300:])  # R²
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.errors import InputError, refuse
from herglotz.stepping import OneStepMethod, State
from herglotz.threads import one_thread
from herglotz.training import FitConfig, fit

try:
    from sklearn.base import BaseEstimator, RegressorMixin  # pyright: ignore[reportMissingImports]
    from sklearn.utils.validation import check_is_fitted  # pyright: ignore[reportMissingImports]
except ImportError:
    raise ImportError("HerglotzRegressor needs scikit-learn; install it: pip install 'herglotz[sklearn]'") from None

# Times closer than this part of a step are equal.
SAME = 1e-9


class HerglotzRegressor(RegressorMixin, BaseEstimator):
    """Positions as a function of time, and of inputs if X has more than one column.

    X is (N,) or (N, 1 + m): increasing times, then inputs, each of which acts from the time of its row on. y is (N,) or
    (N, n): positions. A fit has one motion. `predict` takes any time after the first sample; with inputs, times after
    the last fitted sample, at steps like those of the data.

    Parameters
    ----------
    level, objective, seed
        As in `FitConfig`.
    angles
        Whether every coordinate is an angle in rad.
    train_fraction
        Part of the samples that is trained on; by default all, because scikit-learn holds samples out itself.
    settings
        Further settings of `FitConfig`, by name.

    Attributes
    ----------
    run_
        The `Run`: `run_.equation()`, `run_.verify()`, `run_.export(...)`.
    n_features_in_, feature_names_in_
        Columns of X, and their names if X is a DataFrame: `predict` takes the same columns in the same order.

    Raises
    ------
    InputError
        If X or y cannot be used, times do not increase, or a step fails; the message names the time. An `InputError`
        is a `ValueError`, which scikit-learn expects.
    """

    def __init__(
        self,
        level: str = "auto",
        objective: str = "auto",
        seed: int = 0,
        angles: bool = False,
        train_fraction: float = 1.0,
        settings: dict[str, Any] | None = None,
    ):
        self.level = level
        self.objective = objective
        self.seed = seed
        self.angles = angles
        self.train_fraction = train_fraction
        self.settings = settings

    def fit(self, X: Any, y: Any) -> HerglotzRegressor:
        """Fit a model to positions y at the times X[:, 0]."""
        names, flat = _names(X), y is not None and np.asarray(y).ndim == 1
        X, q = _matrix("X", X), _matrix("y", y)
        if len(X) != len(q):
            raise InputError(f"X has {len(X)} rows and y {len(q)}; give one position a time")
        n = q.shape[1]
        u = X[:, 1:] if X.shape[1] > 1 else None
        data = Trajectories.of(X[:, 0], q, u=u, angles=(self.angles,) * n, source="X", hold="" if u is None else "zero")
        config = FitConfig(
            level=self.level, objective=self.objective, seed=self.seed, train_fraction=self.train_fraction
        )
        # The input of a row of X acts from the time of this row on.
        at_once = {"input_delay": 0.0, "actuator_lag": 0.0}
        if any((self.settings or {}).get(name) for name in at_once):
            raise InputError("input_delay, actuator_lag: inputs act in the row of X that has them; use herglotz.fit")
        self.run_ = fit(data, config.changed({**(self.settings or {}), **at_once}), progress=False)
        self.n_features_in_, self._flat = X.shape[1], flat
        # An earlier fit may have had other names.
        self.__dict__.pop("feature_names_in_", None)
        if names is not None:
            self.feature_names_in_ = names
        return self

    def __sklearn_tags__(self) -> Any:
        """Several coordinates are several outputs."""
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    @one_thread()
    def predict(self, X: Any) -> np.ndarray:
        """Positions at the times X[:, 0], in any order without inputs; the shape is that of y."""
        check_is_fitted(self, "run_")
        names, fitted = _names(X), getattr(self, "feature_names_in_", None)
        if names is not None and fitted is not None and [*names] != [*fitted]:
            raise InputError(f"X has the columns {', '.join(names)}, the fit had {', '.join(fitted)}; give the same")
        X = _matrix("X", X)
        if X.shape[1] != self.n_features_in_:
            wanted = f"{type(self).__name__} is expecting {self.n_features_in_} features as input: times, then inputs"
            raise InputError(f"X has {X.shape[1]} features, but {wanted}. Reshape your data: one row a time")
        with torch.no_grad():
            q = self._free(X[:, 0]) if self.run_.data.u is None else self._driven(X)
        if not np.isfinite(q).all():
            at = X[int((~np.isfinite(q)).any(1).argmax()), 0]
            raise InputError(f"the free run fails before t = {at:g}; predict earlier times, or fit more data")
        return q[:, 0] if self._flat else q

    def _free(self, times: np.ndarray) -> np.ndarray:
        """Positions at each time, by steps of the model from the last fitted sample before that time."""
        run = self.run_
        nodes = run.data.t.double().numpy()[: run.train_lengths[0]]
        if times.min() < nodes[0] - SAME * run.h:
            raise InputError(f"t = {times.min():g} is before the first fitted sample, {nodes[0]:g}; take later times")
        found = np.empty((len(times), run.data.dof))
        origin = np.searchsorted(nodes, times + SAME * run.h, side="right") - 1
        for k in np.unique(origin):
            start = State(*(x[int(k)].detach() for x in run.states))
            asked = np.flatnonzero(origin == k)
            found[asked] = self._from(start, times[asked] - nodes[k])
        return found

    def _from(self, start: State, spans: np.ndarray) -> np.ndarray:
        """Positions at the times `spans` ≥ 0 after a state."""
        run = self.run_
        steps = np.round(spans / run.h).astype(int)
        if np.allclose(spans, run.h * steps, atol=1e-6 * run.h, rtol=1e-9):
            stepper, sizes, row = run.stepper, np.full(steps.max(), run.h), steps
        # If the times are no multiples of h, each step leads from one time to the next.
        else:
            stepper, ends = run.at_step(run.h_range[0] / 2), np.unique(spans[spans > SAME * run.h])
            sizes, row = np.diff(ends, prepend=0.0), np.searchsorted(ends, spans) + (spans > SAME * run.h)
        return self._positions(stepper, start, sizes)[row]

    def _positions(
        self, stepper: OneStepMethod, start: State, sizes: np.ndarray, inputs: Tensor | None = None
    ) -> np.ndarray:
        """Positions (K + 1, n) over K steps of these sizes, in float64."""
        if not len(sizes):
            return start.q[None].double().numpy()
        with torch.no_grad():
            return stepper.rollout(*start, h=torch.from_numpy(sizes), inputs=inputs).q.double().numpy()

    def _driven(self, X: np.ndarray) -> np.ndarray:
        """Positions from the last fitted sample on; the input of a row acts until the time of the next row."""
        run = self.run_
        start, fitted = run.last_fitted()
        last = run.data.offsets[0] + run.train_lengths[0] - 1
        u, (low, high) = run.data.u, run.h_range
        assert u is not None
        t, before = X[:, 0], np.maximum.accumulate(np.r_[fitted, X[:-1, 0]])
        step = t - before
        moves, back = step > SAME * run.h, step < -SAME * run.h
        wrong = back | (moves & ~((low <= step) & (step <= high)))
        if wrong.any():
            i = int(wrong.argmax())
            text = f"a step of {step[i]:g}, the data had {low:g} to {high:g}; resample X"
            if back[i]:
                text = f"t = {t[i]:g} is before {before[i]:g}; with inputs, times increase from the fit"
            raise InputError(f"row {i} of X: {text}")
        acts = torch.cat([u[last : last + 1], u.new_tensor(X[:-1, 1:])])[torch.from_numpy(moves)]
        return self._positions(run.stepper, start, step[moves], acts)[moves.cumsum()]


def _names(X: Any) -> np.ndarray | None:
    """The names of the columns of a DataFrame if all of them are strings; otherwise None."""
    names = [*getattr(X, "columns", ())]
    return np.array(names, dtype=object) if names and all(isinstance(name, str) for name in names) else None


def _matrix(name: str, x: Any) -> np.ndarray:
    """(N,) or (N, m) finite numbers as (N, m) float64; scikit-learn's own checks look for words of the messages."""
    refuse({
        f"{name}: this estimator requires {name} to be passed, but the target {name} is None": x is None,
        f"{name}: sparse input is not supported; give {name}.toarray()": hasattr(x, "toarray"),
    })  # fmt: skip
    try:
        raw = np.asarray(x)
        found = None if raw.dtype.kind == "c" else raw.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not numbers ({error})") from None
    if found is None:
        raise InputError(f"{name}: Complex data not supported; give real numbers")
    found = found[:, None] if found.ndim == 1 else found
    if found.shape[1:] == (0,):
        raise InputError(f"{name}: 0 feature(s) (shape={found.shape}) while a minimum of 1 is required: a column")
    if found.ndim != 2 or not found.size:
        raise InputError(f"{name} must be (N,) or (N, m) with N ≥ 1, got shape {found.shape}")
    if not np.isfinite(found).all():
        raise InputError(f"{name}: row {int((~np.isfinite(found)).any(1).argmax())} is NaN or inf; drop that row")
    return found
