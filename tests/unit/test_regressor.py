"""scikit-learn's interface: fit, predict and score of one motion; scikit-learn's own checks where it is installed."""

import importlib
import importlib.util
import pickle
import sys
import types
from dataclasses import replace
from importlib.machinery import ModuleSpec
from typing import Any

import numpy as np
import pytest
import torch

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper
from herglotz.training import FitConfig, Run
from herglotz.training.recorded_range import box_of

INSTALLED = importlib.util.find_spec("sklearn") is not None
H = 0.2
AT_ONCE: Any = {"input_delay": 0.0, "actuator_lag": 0.0}


class Base:
    """Stands in for BaseEstimator and RegressorMixin."""

    def score(self, X, y):
        return 1 - np.sum((self.predict(X) - y) ** 2) / np.sum((y - np.mean(y)) ** 2)  # pyright: ignore


@pytest.fixture
def regressor(monkeypatch):
    if not INSTALLED:
        base, validation = types.ModuleType("sklearn.base"), types.ModuleType("sklearn.utils.validation")
        base.BaseEstimator, base.RegressorMixin = type("Mixin", (), {}), Base  # pyright: ignore
        validation.check_is_fitted = lambda model, name: getattr(model, name)  # pyright: ignore
        for one in (types.ModuleType("sklearn"), types.ModuleType("sklearn.utils"), base, validation):
            one.__spec__ = ModuleSpec(one.__name__, None)  # torch asks for it
            monkeypatch.setitem(sys.modules, one.__name__, one)
    monkeypatch.delitem(sys.modules, "herglotz.regressor", raising=False)
    return importlib.import_module("herglotz.regressor").HerglotzRegressor


def oscillator(**options):
    """x″ = −x − 0.1 x′ (+ u)."""
    one = (1.0,)
    return ContactLagrangian(ModelConfig((False,), **options, scale=one, speed=one, stiffness=one, tilt=(0.0,),
                                         rate=0.1, potential_width=0))  # fmt: skip


def known(monkeypatch, regressor, model, motion):
    """Let `fit` find this model and this motion of it."""

    def fit(data, config, progress):
        assert (config, progress) == (FitConfig(level="auto", seed=7, train_fraction=1.0, **AT_ONCE), False)
        n = data.samples
        states = State(*(x[:n] for x in (motion.q, motion.p, motion.s)))
        torch.testing.assert_close(data.q, states.q)
        return Run(model, config, {}, data, (n,), states, H, box_of(*states), [])

    monkeypatch.setattr(sys.modules[regressor.__module__], "fit", fit)
    return regressor(seed=7)


@torch.no_grad()
def test_fit_predict_score(regressor, monkeypatch):
    # fails if the motion does not go on from the fit, times are taken in the wrong order, or a part of a step is lost
    model = oscillator(level="linear")
    start = torch.tensor([1.0]).double(), torch.tensor([0.0]).double(), torch.tensor(0.0).double()
    motion = Stepper(model).rollout(*start, h=H, steps=60)
    t, q = H * np.arange(61), motion.q[:, 0].numpy()
    found = known(monkeypatch, regressor, model, motion).fit(t[:40], q[:40])
    assert found.score(t[40:], q[40:]) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(found.predict(t[[50, 3]]), q[[50, 3]], atol=1e-12)
    # Between samples: the motion of the rule, whose frequency is off by h²/24; measured 4e-3, a step is 0.2.
    between = np.array([9.13, 2.05])
    free = np.exp(-0.05 * between) * (np.cos(between) + 0.05 * np.sin(between))
    np.testing.assert_allclose(found.predict(between), free, atol=2e-2)
    assert found.predict(t[:3, None]).shape == (3,)
    with pytest.raises(InputError, match="before the first fitted sample"):
        found.predict([-1.0])


@torch.no_grad()
def test_inputs_drive_the_prediction(regressor, monkeypatch):
    # fails if an input acts a row too late, or not at all
    model, u = oscillator(level="forced", inputs=1, input_map=(1.0,)), np.random.default_rng(0).normal(size=41)
    start = torch.tensor([1.0]).double(), torch.tensor([0.0]).double(), torch.tensor(0.0).double()
    motion = Stepper(model).rollout(*start, h=H, steps=40, inputs=torch.from_numpy(u[:40, None]))
    X, q = np.stack([H * np.arange(41), u], 1), motion.q.numpy()
    found = known(monkeypatch, regressor, model, motion).fit(X[:20], q[:20])
    np.testing.assert_allclose(found.predict(X[19:]), q[19:], atol=1e-12)
    with pytest.raises(InputError, match="row 1 of X: a step of"):
        found.predict(X[[20, 30]])
    with pytest.raises(InputError, match="X has 1 features, but HerglotzRegressor is expecting 2 features"):
        found.predict(X[20:, :1])
    with pytest.raises(InputError, match="input_delay, actuator_lag: inputs act in the row of X"):
        regressor(settings={"input_delay": 0.1}).fit(X[:20], q[:20])


@torch.no_grad()
def test_inputs_that_are_ignored_are_not_asked_for(regressor, monkeypatch):
    # fails if settings={"use_inputs": False} ends in an AssertionError: X has inputs, the run has none
    model = oscillator(level="linear")
    start = torch.tensor([1.0]).double(), torch.tensor([0.0]).double(), torch.tensor(0.0).double()
    motion = Stepper(model).rollout(*start, h=H, steps=40)
    X, q = np.stack([H * np.arange(41), np.ones(41)], 1), motion.q.numpy()

    def fit(data, config, progress):
        assert (config.use_inputs, progress) == (False, False)
        states = State(*(x[: data.samples] for x in (motion.q, motion.p, motion.s)))
        return Run(model, config, {}, replace(data, u=None), (data.samples,), states, H, box_of(*states), [])

    monkeypatch.setattr(sys.modules[regressor.__module__], "fit", fit)
    found = regressor(settings={"use_inputs": False}).fit(X[:20], q[:20])
    np.testing.assert_allclose(found.predict(X[19:]), q[19:], atol=1e-12)


def test_a_missing_package_is_named(monkeypatch):  # fails if a newcomer sees a ModuleNotFoundError without a remedy
    monkeypatch.setitem(sys.modules, "sklearn.base", None)
    monkeypatch.delitem(sys.modules, "herglotz.regressor", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'herglotz\[sklearn\]'"):
        importlib.import_module("herglotz.regressor")


@pytest.mark.parametrize(
    ("X", "y", "message"),
    [
        ([0.0, 1.0], None, "requires y to be passed, but the target y is None"),
        ([0.0, 1.0], [1.0, 1j], "y: Complex data not supported"),
        (np.zeros((2, 0)), [1.0, 2.0], "X: 0 feature"),
        ([0.0, np.nan], [1.0, 2.0], "X: row 1 is NaN or inf; drop that row"),
        (types.SimpleNamespace(toarray=None), [1.0], "X: sparse input is not supported"),
    ],
)
def test_what_is_no_table_of_numbers_is_refused(regressor, X, y, message):  # fails if a fit begins, or numpy complains
    with pytest.raises(InputError, match=message):
        regressor().fit(X, y)


def test_columns_with_other_names_are_refused(regressor, monkeypatch):
    # fails if a DataFrame whose columns are swapped is predicted all the same, or names of a fit before are kept
    class Frame:
        def __init__(self, columns):
            self.columns = columns

        def __array__(self, dtype=None, copy=None):
            return np.stack([H * np.arange(20), np.zeros(20)], 1)

    found = quick(monkeypatch, regressor)(settings={"use_inputs": False})
    found.fit(Frame(["t", "F"]), np.arange(20.0))
    assert found.feature_names_in_.tolist() == ["t", "F"]
    assert found.predict(Frame(["t", "F"])).shape == found.predict(np.asarray(Frame([]))).shape == (20,)
    with pytest.raises(InputError, match="X has the columns F, t, the fit had t, F; give the same"):
        found.predict(Frame(["F", "t"]))
    found.fit(np.asarray(Frame([])), np.arange(20.0))
    assert not hasattr(found, "feature_names_in_")


def test_a_fitted_regressor_is_pickled(regressor, monkeypatch):
    # fails if a run holds what pickle does not take: joblib's workers and saved pipelines need it
    t = H * np.arange(20)
    found = quick(monkeypatch, regressor)().fit(t, np.sin(t))
    again = pickle.loads(pickle.dumps(found))
    between = t[:3] + 0.05  # each takes a tenth of a second
    assert again.predict(between).tolist() == found.predict(between).tolist()


def quick(monkeypatch, regressor):
    """Let `fit` take some model, and the positions for its states."""

    def fit(data, config, progress):
        assert not progress
        states, model = State(data.q, 0 * data.q, 0 * data.t), oscillator(level="linear")
        if data.dof > 1:  # of several coordinates nothing is asked between samples
            model = torch.nn.Module()
        return Run(model, config, {}, replace(data, u=None), (data.samples,), states, H, box_of(*states), [])  # pyright: ignore

    monkeypatch.setattr(sys.modules[regressor.__module__], "fit", fit)
    return regressor


EXPECTED_TO_FAIL = {
    "check_dtype_object": "an entry of X that is no number is an InputError, as every wrong input, and no TypeError",
    "check_fit1d": "X may be (N,): times alone",
}


def test_the_checks_of_scikit_learn(regressor, monkeypatch):
    # fails if one of them fails, or one that is expected to fail passes by now. They draw X at random, so that times
    # do not increase, which is an error: rows are put in order here, and columns beside the time left out.
    if not INSTALLED:
        pytest.skip("scikit-learn is an extra")
    pytest.importorskip("sklearn", minversion="1.6", reason="earlier checks have no list of expected failures")
    from sklearn.utils.estimator_checks import check_estimator  # pyright: ignore[reportMissingImports]

    class Ordered(quick(monkeypatch, regressor)):
        def fit(self, X, y):
            whole, positions = (matrix(name, x) for name, x in (("X", X), ("y", y)))
            if len(whole) != len(positions):
                return super().fit(X, y)
            t, rows = np.unique(whole[:, 0], return_index=True)
            super().fit(t, np.asarray(y)[rows])
            self.n_features_in_ = whole.shape[1]
            return self

    Ordered.__qualname__ = "Ordered"  # where pickle finds it
    monkeypatch.setattr(sys.modules[__name__], "Ordered", Ordered, raising=False)
    matrix = sys.modules[regressor.__module__]._matrix
    found = check_estimator(Ordered(), expected_failed_checks=EXPECTED_TO_FAIL, on_skip=None)
    assert {row["check_name"] for row in found if row["status"] == "xfail"} == EXPECTED_TO_FAIL.keys()
    assert sum(row["status"] == "passed" for row in found) > 40  # of 53 in scikit-learn 1.9; some want pandas
