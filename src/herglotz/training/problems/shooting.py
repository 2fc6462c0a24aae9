"""Multiple shooting: the fit of whole trajectories to noisy positions, whose noise one-step errors would amplify.

The unknowns are the parameters θ and the state (q, p[, s]) at the start of every segment. The residuals are

    (q_model − q_data) / σ_i                           at every sample, with σ_i = σ · `balance` of the coordinate i,
    (end of a segment − start of the next) / weight    at every joint between segments,
    (s − s_known or 0) / weight                        at the start of a trajectory, if the motion depends on s,

and the prior. Derivatives run through every implicit step (`lifted_newton.parameter_derivatives`). Segments grow
until each trajectory is one segment.
"""

from __future__ import annotations

from collections.abc import Collection
from copy import copy
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.noise import AT_THE_NOISE, precisions
from herglotz.models import ContactLagrangian
from herglotz.models.terms import FeatureKinetic, PositionKinetic
from herglotz.stepping import Stepper, state_of
from herglotz.training.arrowhead import Arrowhead, Sums, eliminated
from herglotz.training.distributed import everywhere
from herglotz.training.flow import CompiledFlow, Observed
from herglotz.training.kernel import kernel_of
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import SegmentGrid, between_nodes, between_samples
from herglotz.training.problems.least_squares import StatesProblem
from herglotz.training.problems.prior import Gaussian
from herglotz.training.solvers.lifted_newton import (
    SWEPT,
    Path,
    linear_recurrence,
    parameter_derivatives,
    solve_path,
    step_derivatives,
)

# Leading samples that determine the start of a free run: q and q̇ follow from three samples, forces do not.
START_SAMPLES = 3
# Largest σ over the noise: a start state that is known so well does not move.
MAX_PRECISION_RATIO = 1e3
# Samples over which the mass of a joint is averaged.
MASS_SAMPLES = 8


class JointMasses:
    """The masses that momenta at joints are divided by: of the mass matrix, over a few of the positions q (N, n)."""

    def __init__(self, parameters: ParameterVector, q: Tensor):
        self.parameters = parameters
        self.q = q[torch.linspace(0, len(q) - 1, MASS_SAMPLES, device=q.device).round().long()]
        self._made: tuple[Tensor, Tensor] | None = None

    @property
    def move(self) -> bool:
        """Whether the masses depend on the parameters; the mass of the first coordinate is 1."""
        return self.q.shape[1] > 1 and self.parameters.model.config.baseline

    def at(self, theta: Tensor) -> Tensor:
        """At θ, (n,), positive."""
        return self._graph(theta)[1].detach()

    def slopes(self, theta: Tensor) -> Tensor:
        """∂ log mass / ∂θ, (n, P)."""
        own, mass = self._graph(theta)
        if not mass.requires_grad:
            return theta.new_zeros(len(mass), len(theta))
        rows = (torch.autograd.grad(x, own, retain_graph=True)[0] for x in mass)
        return torch.stack(list(rows)) / mass.detach()[:, None]

    def _graph(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """θ and the masses, as autograd remembers them; made once for a θ, which a fit asks for again."""
        if self._made is None or not torch.equal(self._made[0], theta):
            with torch.enable_grad():
                theta = theta.detach().clone().requires_grad_()
                mass = self.parameters.evaluated(theta, lambda model: _mass(model.kinetic, self.q))
                mass = mass.diagonal(0, -2, -1).abs().mean(0).clamp_min(torch.finfo(theta.dtype).tiny ** 0.5)
            self._made = theta, mass
        return self._made


def _mass(kinetic: Any, q: Tensor) -> Tensor:
    """The mass matrix of a kinetic term at positions (k, n), (k, n, n)."""
    if isinstance(kinetic, FeatureKinetic):
        return _mass(kinetic.base, q) + kinetic.mass(q)
    return kinetic.mass(q) if isinstance(kinetic, PositionKinetic) else kinetic.mass().expand(len(q), -1, -1)


class ShootingProblem(StatesProblem):
    """½ Σ (q − q_data)²/σ² + ½ Σ (joint defects / weight)² + prior, over parameters and segment states.

    `used` are the samples in the sum, by default all; the others are outliers. If `s` is known, in the model's unit,
    trajectories start from `s`, otherwise near 0. With `compiled` a kernel evaluates the model if there is one; for a
    few evaluations a kernel is not worth its compilation. `settings` are those of `LeastSquares`; `freedom` is for the
    residuals of data and joints.
    """

    def __init__(
        self,
        model: ContactLagrangian,
        data: Trajectories,
        grid: SegmentGrid,
        *,
        used: Tensor | None = None,  # (N,)
        s: Tensor | None = None,  # (N,)
        compiled: bool = True,
        **settings: Any,
    ):
        super().__init__(model, data, grid, **settings)
        self.used = torch.ones_like(data.t, dtype=torch.bool) if used is None else used
        self.s, self._noise, self.jointed = s, None, bool(grid.joined.any())
        # Defects of momenta at joints are divided by the masses.
        self.masses = JointMasses(self.parameters, data.q)
        # Of a model whose masses do not move.
        self.mass = self.masses_of(model) if self.jointed and not self.masses.move else torch.ones_like(self.scale)
        self._weigh()
        self._solved: tuple[Tensor, Path | None] | None = None
        # The last path, from which the next solve starts, and its unknowns.
        self.path: Path | None = None
        self._at: Tensor | None = None
        # A path and its `sensitivities`, with P + d or d columns.
        self._slopes: tuple[Path, Tensor] | None = None
        # True: if sweeps from the last path do not converge, step through the trajectories.
        self.patient = True
        # Readings of the sensors at q = 0, (N, n), if `WithZeros` fits them.
        self.zeros = data.q.new_zeros(())
        placed = kernel_of(model) if compiled and s is None else None
        self.compiled = None if placed is None else CompiledFlow(placed, grid, self.u, self.n, divided=True)

    def _weigh(self) -> None:
        """Set the weights (N, n) of samples and the scales (d,) of joint defects, which follow from σ."""
        self.better = self._precision_ratios()
        observed = 1.0 if self.data.observed is None else self.data.observed
        self.weight = self.used.to(self.data.q)[:, None] * self.better * observed
        # The scale of a joint defect is the noise for q, and the same share of the motion for p (mass 1) and s.
        relative = self.deviations / self.scale
        action = (self.speed * self.scale * relative)[: self.d - 2 * self.n]
        self.joint_weight = torch.cat([self.scale * relative, self.speed * relative, action])

    def of(self, free: Collection[str], sigma: float, prior: Gaussian | None = None) -> ShootingProblem:
        """The same problem over the parameters named `free`; the others keep their values in the model."""
        other = copy(self)
        other.parameters, other.prior, other.sigma = ParameterVector(self.parameters.model, free), prior, sigma
        other.P, other.deviations = len(other.parameters.numbers), sigma * self.data.balance
        other.masses = JointMasses(other.parameters, self.data.q)
        other._solved = other._at = other._slopes = other.path = None
        other._weigh()
        if other.compiled is not None and (placed := kernel_of(self.parameters.model, other.parameters)):
            other.compiled = copy(other.compiled)
            other.compiled.placed = placed
        return other

    def _precision_ratios(self) -> Tensor:
        """σ over the noise for the leading samples of whole trajectories, 1 for other samples, (N, n).

        If σ, the misfit of the model, exceeds the noise, start states fitted with σ would make up for missing forces.
        The parameters of the least misfit would then not have the least error in a free run from the recorded start.
        """
        if self.jointed:
            return torch.ones_like(self.data.q)
        if self._noise is None:
            self._noise = precisions(self.data).to(self.data.q)
        ratio = (self.sigma / self._noise).clamp(max=MAX_PRECISION_RATIO)
        first = torch.zeros_like(self.data.t, dtype=torch.bool)
        first[(torch.tensor(self.data.offsets)[:, None] + torch.arange(START_SAMPLES)).to(first.device)] = True
        return torch.where(first[:, None] & (ratio > AT_THE_NOISE), ratio, 1.0)

    def memory(self) -> dict[str, Any]:
        """The last path and its unknowns, from which the next solve starts: the last bits of the result depend on them.

        Empty if a kernel ran, which starts from no path.
        """
        if self.path is None or self._at is None or self.compiled is not None:
            return {}
        return {"at": self._at, "x": self.path.x, "A": self.path.A}

    def recall(self, memory: dict[str, Any]) -> None:
        """Inverse of `memory`."""
        at, x, A = (memory[name].to(self.data.q) for name in ("at", "x", "A"))
        self._at, self.path = at, Path(x, A)

    def states(self, q: Tensor, p: Tensor, s: Tensor | None = None) -> Tensor:
        """Join q (S, n), p (S, n) and s (S,) into states (S, d) as the unknowns have them."""
        parts = [q, p] if self.d == 2 * self.n else [q, p, (torch.zeros_like(q[:, 0]) if s is None else s)[:, None]]
        return torch.cat(parts, -1)

    def pack(self, theta: Tensor, states: Tensor) -> Tensor:
        """Flat unknowns from parameters (P,) and segment states (S, d)."""
        return torch.cat([theta, states.reshape(-1)])

    def unknowns(self, theta: Tensor, path: Path) -> Tensor:
        """Flat unknowns from parameters (P,) and the states in which the segments of a path start."""
        return self.pack(theta, path.x[:, 0, : self.d])

    def places(self, segment: int) -> Tensor:
        """Places of the parameters and of the start state of a segment among the unknowns, (P + d,)."""
        return torch.cat([torch.arange(self.P), self.P + torch.arange(segment * self.d, (segment + 1) * self.d)])

    def unpack(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse of `pack`."""
        return x[: self.P], x[self.P :].reshape(-1, self.d)

    @property
    def at_once(self) -> bool:
        """See `solvers.levenberg_marquardt.SumOfSquares`: a kernel makes path and derivatives in one sweep."""
        return self.compiled is not None

    def solve(self, x: Tensor) -> Path | None:
        """The trajectories of all segments at x; None if a step has no solution."""
        if self._at is not None and torch.equal(self._at, x):
            return self.path
        # The path of an accepted step was solved for its cost.
        if self._solved is not None and torch.equal(self._solved[0], x):
            return self._solved[1]
        theta, states = self.unpack(x)
        if self.compiled is not None:
            nodes = self.compiled.run(theta, self.with_s(states), self._observed())
            self._solved = x.clone(), None if nodes is None else Path(nodes, None)
            return self._solved[1]
        start, L_d = self.with_s(states), self.parameters.at(theta, self.u)
        tol = SWEPT * torch.finfo(x.dtype).eps
        with torch.no_grad():
            path = None
            if self.path is not None:
                path = solve_path(L_d, start, self.grid.h, self._guess(x, self.path), tol)
            # Without a path close enough to start from, step through the trajectories.
            if path is None and (self.path is None or self.patient):
                out = Stepper(L_d).rollout(*state_of(start), h=self.grid.h, inputs=self.u)
                if bool(out.ok.all()):
                    path = solve_path(L_d, start, self.grid.h, out.states.joined, tol)
        self._solved = x.clone(), path
        return path

    def _guess(self, x: Tensor, path: Path) -> Tensor:
        """Predicted states (S, K+1, 2n+1) at x, linearised about the unknowns of the last normal equations."""
        if self._at is None or self._slopes is None:
            return path.x
        theta, states = self.unpack(x - self._at)
        _, slopes = self._slopes
        moved = torch.cat([theta.expand(len(states), -1), states], -1)[:, -slopes.shape[-1] :]
        guess = path.x.clone()
        guess[..., : self.d] += (slopes @ moved[:, None, :, None])[..., 0]
        return guess

    def _slopes_of(self, theta: Tensor, path: Path, *, held: bool = False) -> Tensor:
        """`sensitivities`, computed once for a path: after a fit the results need them again."""
        width = self.d + (0 if held else self.P)
        if self._slopes is None or self._slopes[0] is not path or self._slopes[1].shape[-1] != width:
            self._slopes = path, self.sensitivities(theta, path, held=held)
        return self._slopes[1]

    def cost(self, x: Tensor) -> Tensor:
        """½|r|², or the loss of Student's t; infinite if a step has no solution."""
        path = self.solve(x)
        if path is None:
            return x.new_full((), torch.inf)
        fit, joints = self._missed_by(path.x), self._joints(path.x, self._weights(x[: self.P]))
        return self.loss(fit, joints) + self._anchor(x).square().sum() / 2 + self.prior_cost(x[: self.P])

    def normal_equations(
        self, x: Tensor, *, held: bool = False, rows: Tensor | None = None
    ) -> tuple[Tensor, Arrowhead, Tensor]:
        """(cost, JᵀJ, Jᵀr); keeps the path for the next solve. With `held`, θ is frozen and only states are unknown.

        The rows of J of the samples, by the parameters and the start of the segment, are written to `rows`
        (N, n, P + d).
        """
        theta, states = self.unpack(x)
        sums = Sums.zeros(0 if held else self.P, self.grid.segments, self.d, x)
        if self.compiled is None:
            path = self.solve(x)
        else:
            nodes = self.compiled.run(theta, self.with_s(states), self._observed(), sums, rows)
            path = None if nodes is None else Path(nodes, None)
        if not everywhere(path is not None) or path is None:
            matrix = Arrowhead(sums.corner, sums.border, sums.blocks, torch.zeros_like(sums.blocks), self._eliminate)
            return x.new_full((), torch.inf), matrix, x.new_zeros(len(x) - self.P * held)
        self.path, self._at = path, x.clone()
        weights, moving = self._weights(theta), not held and self.masses.move and self.jointed
        slopes = self.masses.slopes(theta) if moving else None
        fit, joints = self._missed_by(path.x), self._joints(path.x, weights)
        if self.compiled is None:
            root = self.root_weights(fit)
            by, slopes_of_nodes = root * self.weight / self.deviations, self._slopes_of(theta, path, held=held)
            sums.add_samples(self.grid, slopes_of_nodes, by, root * fit)
            if rows is not None:
                rows.copy_(by[..., None] * slopes_of_nodes.flatten(0, 1)[self.grid.node][:, : self.n])
        to = self.grid.joined.nonzero()[:, 0]
        root = self.root_weights(joints[to])
        own = None if slopes is None else (root * joints[to])[:, self.n : 2 * self.n, None] * slopes
        upper = sums.add_joints(to, root / weights, root * joints[to], own)
        anchored, anchor = self._anchored() - self.P, self._anchor(x)
        segment, at = anchored // self.d, anchored % self.d
        sums.blocks[segment, at, at] += 1 / self._anchor_weight**2
        sums.by_state[segment, at] += anchor / self._anchor_weight
        cost = self.loss(fit, joints) + anchor.square().sum() / 2 + self.prior_cost(theta)
        if not held:
            _, A, b = self.prior_equations(theta)
            sums.corner.add_(A)
            sums.by_theta.add_(b)
        matrix = Arrowhead(sums.corner, sums.border, sums.blocks, upper, self._eliminate)
        return cost, matrix, torch.cat([sums.by_theta, sums.by_state.flatten()])

    def _observed(self) -> Observed:
        """The samples, less the zeros of their sensors, and their weights for the kernel."""
        y, weight = self.data.q - self.zeros, self.weight / self.deviations
        return Observed(y.contiguous(), weight.contiguous(), float(self.freedom or 0.0))

    def _eliminate(self, diagonal: Tensor, upper: Tensor, columns: Tensor) -> Tensor | None:
        """T⁻¹ columns, (S, d, R), for a block tridiagonal matrix T; None if that fails."""
        if self.compiled is not None:
            return self.compiled.kernel.eliminate(diagonal, upper, columns)
        return eliminated(diagonal, upper, columns)

    def states_at(self, path: Path, samples: Tensor, d: int | None = None) -> Tensor:
        """The fitted state (…, d) at recorded samples, where the segments of the next stage, with its own d, start.

        At a joint this is the end of the earlier segment. With Student's t it is the start of the later segment,
        because joints may break, and the earlier segment then ends elsewhere.
        """
        rows = self.grid.node.clone()
        if self.freedom is not None:
            first = torch.arange(self.grid.segments, device=samples.device) * (self.grid.h.shape[1] + 1)
            rows[self.grid.start_sample] = first
        return path.x[..., : d or self.d].flatten(0, 1)[rows[samples]]

    def guess_from(self, other: ShootingProblem, path: Path) -> Tensor:
        """Start the next solve from a path over other segments, samples or model steps, interpolated linearly.

        Return the interpolated states (S, d) at the starts of segments.
        """
        x = between_nodes(self.grid, self.data, other.grid, other.data, path.x)
        self.path = Path(x, path.A)
        return x[:, 0, : self.d]

    def guess_from_states(self, states: Tensor) -> None:
        """Start the next solve from states (N, 2n+1) at the samples, by cubics; a kernel needs none."""
        if self.compiled is not None:
            return
        x = between_samples(self.grid, self.data, states)
        self.path = Path(x, x[..., None])

    def misfit(self, path: Path) -> Tensor:
        """q_model − q_data over the balance of the coordinates at every sample, (N, n)."""
        return self._missed(path.x) / self.data.balance

    def _missed(self, x: Tensor) -> Tensor:
        """q_model − q_data at every sample, (N, n), with the zeros of the sensors taken off the data."""
        return self.grid.at_samples(x[..., : self.n]) - (self.data.q - self.zeros)

    def joint_residuals(self, path: Path, theta: Tensor) -> Tensor:
        """End of the previous segment minus the start of each segment, (S, d), over the weight of joints."""
        return self._joints(path.x, self._weights(theta))

    def _missed_by(self, x: Tensor) -> Tensor:
        """Residuals (N, n) of the data at states x (S, K+1, 2n+1)."""
        return self.weight * self._missed(x) / self.deviations

    def _joints(self, x: Tensor, weights: Tensor) -> Tensor:
        """Residuals (S, d) of joints at states x (S, K+1, 2n+1), 0 for a segment that starts a trajectory."""
        ends = x[torch.arange(len(x), device=x.device), self.grid.end, : self.d]
        joints = (ends.roll(1, 0) - x[:, 0, : self.d]) / weights
        return torch.where(self.grid.joined[:, None], joints, 0.0)

    def _weights(self, theta: Tensor) -> Tensor:
        """Scales (d,) of joint defects; the scale of a momentum is that of the speed times the mass at θ.

        With a constant mass in the scale, a fit would reduce defects of momenta by a mass that tends to 0.
        """
        with torch.no_grad():
            mass = self.masses.at(theta) if self.masses.move and self.jointed else self.mass
        return torch.cat([self.joint_weight[: self.n], mass * self.joint_weight[self.n : 2 * self.n],
                          self.joint_weight[2 * self.n :]])  # fmt: skip

    @property
    def _anchor_weight(self) -> float:
        """Standard deviation of the first s of a trajectory: the size of the action or, if s is known, of joints."""
        return self.action if self.s is None else float(self.joint_weight[-1])

    def _anchor(self, x: Tensor) -> Tensor:
        """Residuals of the first s of each trajectory."""
        first = x[self._anchored()]
        if self.s is not None and len(first):
            first = first - self.s[self.grid.start_sample[~self.grid.joined]]
        return first / self._anchor_weight

    def _anchored(self) -> Tensor:
        """Indices of the first s of each trajectory among the unknowns; empty if s does not enter the motion."""
        first = (~self.grid.joined).nonzero()[:, 0]
        return self.P + first * self.d + 2 * self.n if self.d > 2 * self.n else first[:0]

    def slopes_at_samples(self, theta: Tensor, path: Path) -> Tensor:
        """Derivatives of positions at samples by the parameters and by the start of the segment, (N, n, P + d)."""
        if self.compiled is None:
            return self._slopes_of(theta, path).flatten(0, 1)[self.grid.node][:, : self.n]
        return self._swept(self.compiled, theta, path, self.P)[0]

    def slopes_by_start(self, theta: Tensor, path: Path) -> tuple[Tensor, Tensor]:
        """Derivatives by the start of the segment, of positions at samples, (N, n, d), and of its end, (S, d, d)."""
        grid, S = self.grid, self.grid.segments
        if self.compiled is None:
            moved = self.sensitivities(theta, path, held=True).detach()  # (S, K + 1, d, d)
            return moved.flatten(0, 1)[grid.node][:, : self.n], moved[torch.arange(S, device=theta.device), grid.end]
        return self._swept(self.compiled, theta, path, 0)

    def _swept(self, flow: CompiledFlow, theta: Tensor, path: Path, free: int) -> tuple[Tensor, Tensor]:
        """Derivatives by `free` parameters and the start, of positions at samples and of the ends of segments."""
        plain = Observed(self.data.q, torch.ones_like(self.data.q), 0.0)
        sums = Sums.zeros(free, self.grid.segments, self.d, theta)
        rows = self.data.q.new_zeros(*self.data.q.shape, free + self.d)
        flow.run(theta, path.x[:, 0], plain, sums, rows)
        return rows, sums.slopes

    def sensitivities(self, theta: Tensor, path: Path, *, held: bool = False) -> Tensor:
        """dX_k/d(θ, own start), (S, K+1, d, P + d), by Z_{k+1} = A_k Z_k + [B_k, 0]; if `held` by the start alone."""
        (S, K), d, L_d = self.grid.h.shape, self.d, self.parameters.at(theta, self.u)
        q1, A = path.x[:, 1:, : self.n], step_derivatives(L_d, path, self.grid)[..., :d, :d]
        B = theta.new_zeros(S, K, d, 0)
        if not held:
            B = parameter_derivatives(L_d, path.x, q1, A, self.grid.h)
        eye = torch.eye(d, dtype=theta.dtype, device=theta.device).expand(S, d, d)
        first = torch.cat([torch.zeros_like(B[:, 0]), eye], -1)
        return linear_recurrence(A, torch.cat([B, theta.new_zeros(S, K, d, d)], -1), first)
