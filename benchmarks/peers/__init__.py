"""Every peer by name: who it is, what it is given, how it is trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec

from .continuous import train_delan, train_hnn, train_lnn, train_neural_ode
from .discrete import train_discrete_lagrangian, train_mlp
from .known_equation import train_known_equation
from .packages import train_ours, train_phlearn, train_sindy
from .rollouts import Predictor


@dataclass(frozen=True)
class Peer:
    """One method.

    By its definition it needs positions or velocities. Velocities are differences of the positions, and where the data
    are simulated there is a second row with the exact ones. "either": positions will do, and there is the second row
    all the same.
    """

    title: str  # as the table says it
    train: Callable[..., Predictor]  # (samples, seed, budget) → predictor
    needs: str  # "positions", "velocities" or "either"
    source: str  # where it comes from and what is fitted
    package: str | None = None  # a package that must be installed

    @property
    def installed(self) -> bool:
        """Whether its package is there."""
        return self.package is None or find_spec(self.package) is not None


PEERS = {
    "ours": Peer("herglotz", train_ours, "positions",
                 "`herglotz.training.fit` with its defaults, in the steps of its model, of which a recorded one may "
                 "hold several; both double pendulums were measured before named terms were tried; stops by itself"),
    "neural_ode": Peer("neural ODE", train_neural_ode, "either",
                       "Chen et al. 2018: v̇ = net(q, v) by torchdiffeq (rk4), error over windows of 9 samples; without "
                       "velocities the one at the start of each window is trained", "torchdiffeq"),
    "mlp": Peer("MLP step map", train_mlp, "positions",
                "net of (q1, (q1 − q0)/h) for the second difference, one step"),
    "hnn": Peer("HNN", train_hnn, "velocities", "Greydanus et al. 2019: net H(q, p), rates; cannot dissipate"),
    "dissipative_hnn": Peer("dissipative HNN", partial(train_hnn, dissipative=True), "velocities",
                            "Sosanya & Greydanus 2022: nets H and D, rates"),
    "lnn": Peer("LNN", train_lnn, "velocities",
                "Cranmer et al. 2020: net L(q, v) on top of ½v·v, accelerations; no friction"),
    "delan": Peer("DeLaN with friction", train_delan, "velocities",
                  "Lutter et al. 2019: nets M(q), V(q) and a viscous friction, accelerations"),
    "discrete_lagrangian": Peer("discrete Lagrangian net", train_discrete_lagrangian, "positions",
                                "Lishkova et al. 2023, base point of Offen 2024: net L_d(q0, q1), residual; cannot "
                                "dissipate"),
    "forced_discrete_lagrangian": Peer("discrete forced Lagrangian net",
                                       partial(train_discrete_lagrangian, forced=True), "positions",
                                       "Hansen, Celledoni & Tapley 2025: nets L and F at midpoints, residual, penalty "
                                       "(log det)² on 128 pairs"),
    "phlearn": Peer("phlearn", train_phlearn, "velocities",
                    "Eidnes et al. 2023, the package: its network, its `train` (srk4, batches of 64), friction of the "
                    "momenta", "phlearn"),
    "sindy": Peer("SINDy (pysindy)", train_sindy, "velocities",
                  "Brunton et al. 2016, the package's STLSQ; for pendulums its terms hold the true equation",
                  "pysindy"),
    "known_equation": Peer("known equation, fitted", train_known_equation, "positions",
                           "the floor: the true equation with 2 (two joints: 6) unknown numbers, and all starts"),
}  # fmt: skip
