"""herglotz as a peer, and published packages as they are: phlearn (pseudo-Hamiltonian networks) and pysindy.

S. Eidnes, A. Stasik, C. Sterud, E. Bøhn, S. Riemer-Sørensen, "Pseudo-Hamiltonian neural networks with state-dependent
external forces", Physica D 446:133673 (2023): ẋ = (S − R) ∂H/∂x with R ≥ 0 diagonal on the momenta.

S. Brunton, J. Proctor, J. N. Kutz, "Discovering governing equations from data by sparse identification of nonlinear
dynamical systems", PNAS 113:3932 (2016).
"""

from __future__ import annotations

import contextlib
import io
import math
import time
import warnings
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.mechanics import legendre_minus
from herglotz.stepping import State, Stepper
from herglotz.training import FitConfig, fit
from herglotz.training.run import Run

from .networks import LEARNING_RATE, WIDTH, count, scales_of, split, substeps
from .rollouts import Flow
from .samples import Samples

THRESHOLDS = (0.003, 0.01, 0.03, 0.1, 0.3)  # of SINDy's sparse regression; a validation part chooses
SHOTS, NEAR = 6, 1e-5  # iterations for the first momentum, and the differences that they use


@dataclass(frozen=True)
class Learned:
    """A fitted stepper as a predictor."""

    run: Run
    h: float

    @property
    def parameters(self) -> int:
        """Number of trained values of the model."""
        return self.run.metrics["parameters"]

    def rollout(self, q0: Tensor, q1: Tensor, steps: int, exact: Tensor | None = None) -> Tensor:  # noqa: ARG002
        """See `rollouts.Predictor`. The model takes its own steps, of which a recorded one may hold several."""
        stepper, parts = Stepper(self.run.model), max(1, round(self.h / self.run.h))
        with torch.no_grad():
            start = self._start(stepper, q0, q1, parts)
            return stepper.rollout(*start, h=self.h / parts, steps=parts * (steps + 1)).q[:, ::parts]

    def _start(self, stepper: Stepper, q0: Tensor, q1: Tensor, parts: int) -> State:
        """The state at q0 from which the model is at q1 after a recorded step: Newton's iteration by differences."""
        s = torch.zeros_like(q0[:, 0])
        p = legendre_minus(self.run.model, q0, q1, s, torch.full_like(s, self.h))[1]
        for _ in range(SHOTS if parts > 1 else 0):  # one step ends at q1 by its momentum
            moved = [p, *(p + NEAR * e for e in torch.eye(p.shape[-1], dtype=p.dtype))]
            each = [stepper.rollout(q0, x, s, h=self.h / parts, steps=parts).q[:, -1] for x in moved]
            J = torch.stack([(x - each[0]) / NEAR for x in each[1:]], -1)
            p = p - torch.linalg.solve(J, each[0] - q1)
        return State(q0, p, s)


def train_ours(samples: Samples, seed: int, budget: float) -> Learned:  # noqa: ARG001
    """`herglotz.training.fit` on all samples; the budget is not used: it stops by itself."""
    lengths = [len(q) for q in samples.q]
    t = torch.cat([samples.h * torch.arange(k, dtype=torch.float64) for k in lengths])
    data = Trajectories.of(t, torch.cat(samples.q), lengths, angles=samples.angles, source="peers")
    config = FitConfig(train_fraction=1.0, seed=seed)
    return Learned(fit(data, config, progress=False), samples.h)


def train_phlearn(samples: Samples, seed: int, budget: float) -> Flow:
    """The package's own `train` on steps from sample to sample, its fourth-order symmetric scheme, Adam, R on momenta.

    Network of phlearn: tanh, then ReLU; 64 units; float64. Epochs go on until the budget is spent; the weights of the
    best validation loss are kept.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from phlearn import phnns  # pyright: ignore[reportMissingImports]

    began, n, h = time.process_time(), samples.dof, samples.h
    with torch.random.fork_rng():
        torch.manual_seed(seed)  # the package draws from the global generator
        friction = phnns.R_estimator([False] * n + [True] * n, torch.float64)
        friction.pick_rs = friction.pick_rs.double()
        H = phnns.HamiltonianNN(2 * n, WIDTH).double()
        model = phnns.PseudoHamiltonianNN(2 * n, hamiltonian_est=H, dissipation_est=friction, ttype=torch.float64)
        weights = [x for x in (*H.parameters(), *friction.parameters()) if x.requires_grad]
        motions = samples.motions()
        first = torch.cat([torch.cat([m.q, m.p], -1)[:-1] for m in motions])
        last = torch.cat([torch.cat([m.q, m.p], -1)[1:] for m in motions])
        rows, held = split(len(first), torch.Generator().manual_seed(seed))

        def packed(i: Tensor) -> Any:
            t = torch.zeros(len(i), 1, dtype=torch.float64)
            dt = torch.full_like(t, h)
            return (first[i], last[i], t, t + h, dt, torch.zeros_like(first[i])), (last[i] - first[i]) / h

        optimiser = torch.optim.Adam(weights, lr=LEARNING_RATE)
        best, kept = math.inf, [x.detach().clone() for x in weights]
        while (used := (time.process_time() - began) / budget) < 1.0:
            for group in optimiser.param_groups:
                group["lr"] = LEARNING_RATE * (0.5 + 0.5 * math.cos(math.pi * used)) + 1e-6
            with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
                warnings.simplefilter("ignore")
                _, value = phnns.train(
                    model, "srk4", packed(rows), optimiser, packed(held), epochs=1, batch_size=64, verbose=False
                )
            if value is not None and value < best:
                best, kept = value, [x.detach().clone() for x in weights]
        with torch.no_grad():
            for x, value in zip(weights, kept, strict=True):
                x.copy_(value)
    model.train(False)

    def field(y: Tensor) -> Tensor:
        with torch.enable_grad():
            return model._x_dot(y.detach(), torch.zeros(len(y), 1, dtype=torch.float64)).detach()

    parts = substeps(h, scales_of(samples, samples.motion()))
    return Flow(field, h, parts, count(weights), momentum=True)


def library(q: Tensor, v: Tensor, angles: tuple[bool, ...]) -> Tensor:
    """Candidate terms at (q, v), (N, F): 1, vᵢ, vᵢvⱼ, vᵢ³, and all but vᵢ³ times each sine and cosine.

    Of the angles all qᵢ, qᵢ ± qⱼ and twice these are taken. A coordinate that is no angle enters as q, q², q³.
    """
    n, one = q.shape[1], torch.ones_like(q[:, 0])
    speeds = [one, *v.T, *(v[:, i] * v[:, j] for i in range(n) for j in range(i, n))]
    waves = []
    for weights in product((-1, 0, 1), repeat=n):
        lead = next((w for w in weights if w), 0)
        if lead > 0 and all(angle or not w for w, angle in zip(weights, angles, strict=True)):
            turn = q @ torch.tensor(weights, dtype=q.dtype)
            waves += [turn.sin(), turn.cos(), (2 * turn).sin(), (2 * turn).cos()]
    lengths = [q[:, i] ** k for i in range(n) if not angles[i] for k in (1, 2, 3)]
    return torch.stack([*speeds, *(v.T**3), *(a * b for a in speeds for b in waves), *lengths], -1)


def train_sindy(samples: Samples, seed: int, budget: float) -> Flow:  # noqa: ARG001
    """Sparse regression (STLSQ) on rates over `library`; the threshold with the least validation error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pysindy  # pyright: ignore[reportMissingImports]

        motion, n = samples.motion(), samples.dof
        terms, rates = library(motion.q, motion.v, samples.angles).numpy(), motion.a.numpy()
        rows, held = (i.numpy() for i in split(len(terms), torch.Generator().manual_seed(seed)))
        best, coefficients = float("inf"), np.zeros((n, terms.shape[1]))
        for threshold in THRESHOLDS:
            optimiser = pysindy.STLSQ(threshold=threshold, alpha=1e-9, max_iter=50)
            found = optimiser.fit(terms[rows], rates[rows]).coef_
            error = float(np.square(terms[held] @ found.T - rates[held]).mean())
            # The largest threshold that is as good as the best: the sparsest of equals.
            if error <= best * 1.02 + 1e-24:
                best, coefficients = min(error, best), found
    weights = torch.as_tensor(np.array(coefficients))  # q̇ = v needs no regression

    def field(y: Tensor) -> Tensor:
        q, v = y[:, :n], y[:, n:]
        return torch.cat([v, library(q, v, samples.angles) @ weights.T], -1)

    used = int((weights != 0).sum())
    parts = 4 * substeps(samples.h, scales_of(samples, motion))  # its terms are cheap and may be exact
    return Flow(field, samples.h, parts, used)
