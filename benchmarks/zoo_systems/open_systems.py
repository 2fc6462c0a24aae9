"""Systems that no dictionary of terms holds: `open_draw(seed, index)`.

Potentials are log-cosh or quartic wells with Gaussian bumps, or periodic sums of narrow bumps; springs saturate or act
on one side; damping depends on position, saturates or differs by direction; masses follow from linkages (crank, cam,
wire, variable length); friction depends on the action (Herglotz, L = v²/2 − V − γ s − β s²); bodies move above magnets.

The protocol is that of the zoo, with a warm-up of 20 samples and 200 predicted steps. Motions are RK4 in fine steps. A
draw is kept where its true equation predicts to `ATTAINABLE` times the noise, its start state read from the warm-up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from benchmarks.zoo_systems import drawing
from benchmarks.zoo_systems.drawing import ATTAINABLE, PERIOD, between, log_uniform
from benchmarks.zoo_systems.mechanisms import FINE, Array, Values
from benchmarks.zoo_systems.systems import EXACT, Recording, ZooSystem

WARMUP, AHEAD = 20, 200  # samples that a start state is read from, and steps that are predicted from it
STARTS = 3  # unseen starts
Slope = Callable[[Array, Array, Array, Array], tuple[Array, Array]]
Force = Callable[[Array, Array], Array]  # (…), (…) position and velocity → (…)
Gradient = Callable[[Array], Array]


@dataclass(frozen=True)
class OpenMechanism:
    """An equation of motion with hidden states: (q̈, ẇ) = slope(q, q̇, w, u)."""

    kind: str
    n: int  # number of coordinates
    angles: tuple[bool, ...]
    slope: Slope  # (B, n), (B, n), (B, hidden), (B,) → (B, n), (B, hidden)
    values: Values  # the drawn numbers, for the report
    reach: tuple[float, float] = (1.0, 0.8)  # of start positions and velocities
    friction: str = "viscous"
    hidden: int = 0  # action, or internal variable of a hysteresis; 0 at the start


def motion(of: OpenMechanism, x0: Array, t: Array, u: Array, fine: float = FINE) -> Array:
    """Positions (B, N, n) from states (B, 2n + hidden), by RK4 in steps of at most `fine`; inputs are held."""
    n, y, out = of.n, x0, [x0[:, : of.n]]
    for k in range(len(t) - 1):
        count = int(np.ceil((t[k + 1] - t[k]) / fine))
        h = (t[k + 1] - t[k]) / count

        def rate(y: Array, held: Array = u[:, k]) -> Array:
            a, dw = of.slope(y[:, :n], y[:, n : 2 * n], y[:, 2 * n :], held)
            return np.concatenate([y[:, n : 2 * n], a, dw], -1)

        for _ in range(count):
            k1 = rate(y)
            k2 = rate(y + h / 2 * k1)
            k3 = rate(y + h / 2 * k2)
            y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + h * k3))
        out.append(y[:, :n])
    return np.stack(out, 1)


def attainable(of: OpenMechanism, x0: Array, data: Recording, floor: Array) -> float:
    """Error over the noise of the true equation, its start state read from the warm-up: linear in the noise.

    With sensitivities Z of the motion and noise e, the state is off by δ = Z⁺e over the warm-up, the run by Z δ.
    """
    offset = 1e-6
    # The start and a neighbour of the start along each state: one batch.
    starts = [x0 + offset * row for row in (0 * x0[0], *np.eye(x0.shape[1]))]
    moved = motion(of, np.concatenate(starts), data.t, np.tile(data.u, (len(starts), 1)), PERIOD / 60)
    moved = moved.reshape(len(starts), *data.truth.shape)
    Z = np.moveaxis((moved[1:] - moved[0]) / offset, 0, -1) / floor[:, None]  # (B, N, n, 2n + hidden)
    noise = np.random.default_rng(0).standard_normal(data.truth.shape)
    errors = []
    for z, e in zip(Z, noise, strict=True):
        delta = np.linalg.lstsq(z[:WARMUP].reshape(-1, z.shape[-1]), e[:WARMUP].ravel(), rcond=1e-10)[0]
        errors.append(e[WARMUP:] - z[WARMUP:] @ delta)
    return float(np.sqrt(np.mean(np.square(errors))))


def open_draw(seed: int, index: int, attempts: int = 60) -> ZooSystem:
    """System `index` of the open zoo `seed`, the same in a zoo of any size.

    Raises
    ------
    RuntimeError
        If no attempt gives a motion that the true equation predicts.
    """
    rng = np.random.default_rng([7, seed, index])
    kind = list(KINDS)[int(rng.integers(len(KINDS)))]
    for _ in range(attempts):
        driven = rng.random() < 0.35
        mechanism = KINDS[kind](rng, between(rng, 0.5, 1.5) if driven else 0.0)
        rate, count = log_uniform(rng, 15, 100), int(rng.choice([1, 2, 3, 5, 10]))
        samples = min(int(np.clip(between(rng, 4, 15) * rate, 90, 450)), 1500 // count)
        noise = 0.0 if rng.random() < 0.3 else log_uniform(rng, 0.001, 0.02)
        units = log_uniform(rng, 1e-3, 10), 1 / log_uniform(rng, 0.5, 30)
        found = recorded(rng, mechanism, (seed, index), driven, rate, (count, samples), noise, units)
        if found is not None and found.attainable <= ATTAINABLE:
            return found
    raise RuntimeError(f"open zoo {seed}, system {index} ({kind}): nothing predictable in {attempts} attempts")


def recorded(
    rng: Generator, of: OpenMechanism, place: tuple[int, int], driven: bool, rate: float, size: tuple[int, int],
    noise: float, units: tuple[float, float],
) -> ZooSystem | None:  # fmt: skip
    """Recordings of a mechanism; None where it runs away, rests or turns too fast."""
    drawn = []
    for starts, length in (size, (STARTS, WARMUP + AHEAD)):
        t = drawing.sample_times(rng, length, PERIOD / rate, 0.0)
        u = drawing.draw_inputs(rng, starts, t, between(rng, 0.3, 1.0)) if driven else np.zeros((starts, length))
        x0 = np.concatenate([r * rng.uniform(-1, 1, (starts, of.n)) for r in of.reach], -1)
        x0 = np.concatenate([x0, np.zeros((starts, of.hidden))], -1)
        with np.errstate(all="ignore"):
            truth = motion(of, x0, t, u)
        if not np.isfinite(truth).all() or np.abs(truth).max() > drawing.LARGEST:
            return None
        if (np.abs(np.diff(truth[..., list(of.angles)], axis=1)) >= drawing.TURN).any():
            return None
        drawn.append((x0, t, truth, u, rng.standard_normal(truth.shape)))
    spread = drawn[0][2].reshape(-1, of.n).std(0)
    if not (spread > drawing.SMALLEST).all():
        return None
    train, test = (Recording(t, truth + noise * spread * z, truth, u) for _, t, truth, u, z in drawn)
    best = attainable(of, drawn[1][0], test, max(noise, EXACT) * spread)
    return ZooSystem(
        *place, of, of, of.friction, driven, rate, noise, noise * spread, spread, train, test, WARMUP, *units, best
    )


def well(rng: Generator, values: Values) -> Gradient:
    """V′ of a log-cosh or quartic well with two to four Gaussian bumps."""
    count = int(rng.integers(2, 5))
    c, w = rng.uniform(-1, 1, count), rng.uniform(0.15, 0.5, count)
    A = rng.choice([-1.0, 1.0], count) * rng.uniform(0.3, 1.0, count) * w  # forces of 0.2 to 0.6 at the flanks
    steep, hard = between(rng, 1.0, 3.0), between(rng, 0.7, 1.5)
    values |= {"steep": steep if rng.random() < 0.5 else 0.0, "hard": hard}
    values |= {f"{name}{j}": float(x) for name, row in (("A", A), ("c", c), ("w", w)) for j, x in enumerate(row)}

    def gradient(x: Array) -> Array:
        base = hard * np.tanh(steep * x) if values["steep"] else hard * x**3
        d = (x[..., None] - c) / w
        return base - (A / w * d * np.exp(-d * d / 2)).sum(-1)

    return gradient


def damping(rng: Generator, values: Values) -> tuple[str, Force]:
    """A friction force by position, saturating, or different in both directions, and its name."""
    kind = str(rng.choice(["position", "tanh", "direction"]))
    d, e = log_uniform(rng, 0.02, 0.1), between(rng, 0.1, 0.4)
    c, w = between(rng, -0.5, 0.5), between(rng, 0.3, 0.8)
    values |= {"d": d, "e": e, "place": c, "width": w}
    if kind == "position":
        return kind, lambda q, v: (d + e * np.exp(-(((q - c) / w) ** 2))) * v
    if kind == "tanh":
        return kind, lambda q, v: d * v + 0.3 * e * np.tanh(v / (0.5 * w))  # noqa: ARG005
    return kind, lambda q, v: np.where(v > 0, d, d + e / 2) * v  # noqa: ARG005


def single(gradient: Gradient, rub: Force, b: float) -> Slope:
    """One coordinate of mass 1."""
    return lambda q, v, w, u: (-gradient(q) - rub(q, v) + b * u[:, None], w)


def _bumps(rng: Generator, b: float) -> OpenMechanism:
    values: Values = {"b": b}
    gradient, (friction, rub) = well(rng, values), damping(rng, values)
    return OpenMechanism("bumps", 1, (False,), single(gradient, rub, b), values, friction=friction)


def _ring(rng: Generator, b: float) -> OpenMechanism:
    """A periodic potential of narrow bumps: Σ A exp(κ (cos(θ − c) − 1))."""
    count = int(rng.integers(2, 4))
    A, kappa, c = rng.uniform(-0.5, 0.5, count), rng.uniform(3, 12, count), rng.uniform(-np.pi, np.pi, count)
    values: Values = {"b": b, **{f"{n}{j}": float(x[j]) for n, x in zip("Akc", (A, kappa, c), strict=True)
                                 for j in range(count)}}  # fmt: skip

    def gradient(x: Array) -> Array:
        d = x[..., None] - c
        return np.sin(x) - (A * kappa * np.sin(d) * np.exp(kappa * (np.cos(d) - 1))).sum(-1)

    friction, rub = damping(rng, values)
    by_turn: Force = lambda q, v: rub(np.sin(q), v)  # noqa: E731  friction is periodic, too
    return OpenMechanism("ring", 1, (True,), single(gradient, by_turn, b), values, (2.5, 1.0), friction)


def _springs(rng: Generator, b: float) -> OpenMechanism:
    """One to three masses between walls, by springs that saturate or act on one side."""
    n = int(rng.integers(1, 4))
    k, limit = rng.uniform(0.8, 2.0, n + 1), rng.uniform(0.3, 0.8, n + 1)
    one_sided, mass = rng.random(n + 1) < 0.35, rng.uniform(0.5, 2.0, n)
    one_sided[0] = False  # something holds the masses
    d = log_uniform(rng, 0.02, 0.1)
    values: Values = {"b": b, "d": d}
    values |= {f"{name}{j}": float(x) for name, row in (("k", k), ("limit", limit), ("one", one_sided), ("m", mass))
               for j, x in enumerate(row)}  # fmt: skip

    def slope(q: Array, v: Array, w: Array, u: Array) -> tuple[Array, Array]:
        wall = np.zeros((len(q), 1))
        stretch, rate = (np.diff(np.concatenate([wall, x, wall], -1)) for x in (q, v))
        tension = np.where(one_sided, k * np.maximum(stretch, 0.0), limit * np.tanh(k * stretch / limit))
        f = np.diff(tension + d * np.tanh(2 * rate) + 0.3 * d * rate)
        f[:, 0] += b * u
        return f / mass, w

    return OpenMechanism("springs", n, (False,) * n, slope, values, friction="tanh")


def linkage(f: Callable[[Array], tuple[Array, Array, Array]], J: float, pull: float, hold: float, d: float,
            b: float) -> Slope:  # fmt: skip
    """A part of inertia J that drives a mass 1 through y = f(θ): (J + f′²) θ̈ + f′ f″ θ̇² + (pull + hold y) f′ = …."""

    def slope(q: Array, v: Array, w: Array, u: Array) -> tuple[Array, Array]:
        y, y1, y2 = f(q)
        force = -y1 * y2 * v * v - (pull + hold * y) * y1 - d * v + b * u[:, None]
        return force / (J + y1 * y1), w

    return slope


def crank(r: float) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Position of the slider of a crank r with a rod of length 1, and its derivatives by the angle."""

    def f(q: Array) -> tuple[Array, Array, Array]:
        s, c = np.sin(q), np.cos(q)
        rod = np.sqrt(1 - (r * s) ** 2)
        y1 = -r * s - r * r * s * c / rod
        return r * c + rod, y1, -r * c - r * r * (c * c - s * s) / rod - (r * r * s * c) ** 2 / rod**3

    return f


def cam(e: float, kappa: float) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Lift e exp(κ (cos θ − 1)) of a cam, and its derivatives."""

    def f(q: Array) -> tuple[Array, Array, Array]:
        y = e * np.exp(kappa * (np.cos(q) - 1))
        return y, -kappa * np.sin(q) * y, (kappa**2 * np.sin(q) ** 2 - kappa * np.cos(q)) * y

    return f


def wire(a: float, e: float, w: float) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Height of a wire, a parabola with a bump, and its derivatives."""

    def f(x: Array) -> tuple[Array, Array, Array]:
        bump = e * np.exp(-((x / w) ** 2) / 2)
        return a * x * x / 2 + bump, a * x - x / w**2 * bump, a + (x * x / w**4 - 1 / w**2) * bump

    return f


def _linkage(rng: Generator, b: float) -> OpenMechanism:
    kind = str(rng.choice(["crank", "cam", "wire"]))
    J, d, one, two = between(rng, 0.3, 1.0), log_uniform(rng, 0.02, 0.15), rng.random(), rng.random()
    values: Values = {"b": b, "J": J, "d": d, "one": one, "two": two}
    if kind == "crank":
        return OpenMechanism(kind, 1, (True,), linkage(crank(0.3 + 0.4 * one), J, 1.0, two, d, b), values, (3.0, 1.5))
    if kind == "cam":
        f = cam(0.4 + 0.4 * one, 1.0 + 2.0 * two)
        return OpenMechanism(kind, 1, (True,), linkage(f, J, 1.0, 0.5, d, b), values, (3.0, 1.5))
    f = wire(0.7 + 0.6 * one, 0.15 + 0.3 * two, 0.4)
    return OpenMechanism(kind, 1, (False,), linkage(f, 1.0, 1.0, 0.0, d, b), values, (1.2, 0.8))


def variable_length(e: float, turns: int, d: float, b: float) -> Slope:
    """A bob on a pendulum of length ℓ(θ) = 1 + e cos(turns · θ): mass ℓ² + ℓ′², V = −ℓ cos θ."""

    def slope(q: Array, v: Array, w: Array, u: Array) -> tuple[Array, Array]:
        length, l1 = 1 + e * np.cos(turns * q), -e * turns * np.sin(turns * q)
        l2 = -e * turns**2 * np.cos(turns * q)
        gradient = length * np.sin(q) - l1 * np.cos(q)
        force = -l1 * (length + l2) * v * v - gradient - d * v + b * u[:, None]
        return force / (length**2 + l1**2), w

    return slope


def _length(rng: Generator, b: float) -> OpenMechanism:
    values: Values = {"b": b, "e": between(rng, 0.1, 0.35), "turns": int(rng.integers(1, 4)),
                      "d": log_uniform(rng, 0.02, 0.15)}  # fmt: skip
    slope = variable_length(float(values["e"]), int(values["turns"]), float(values["d"]), b)
    return OpenMechanism("length", 1, (True,), slope, values, (2.2, 0.8))


def herglotz(V: Gradient, gradient: Gradient, gamma: float, beta: float, b: float) -> Slope:
    """L = v²/2 − V − γ s − β s² (+ b u q): q̈ = −V′ − (γ + 2 β s) q̇ + b u, and ṡ = L."""

    def slope(q: Array, v: Array, w: Array, u: Array) -> tuple[Array, Array]:
        a = -gradient(q) - (gamma + 2 * beta * w) * v + b * u[:, None]
        return a, v * v / 2 - V(q) - gamma * w - beta * w * w + b * u[:, None] * q

    return slope


def _herglotz(rng: Generator, b: float) -> OpenMechanism:
    k, k3 = between(rng, 0.5, 1.5), between(rng, 0.0, 2.0)
    gamma, beta = between(rng, 0.05, 0.2), between(rng, 0.05, 0.3)
    values: Values = {"b": b, "k": k, "k3": k3, "gamma": gamma, "beta": beta}
    V: Gradient = lambda x: k * x * x / 2 + k3 * x**4 / 4  # noqa: E731
    slope = herglotz(V, lambda x: k * x + k3 * x**3, gamma, beta, b)
    return OpenMechanism("herglotz", 1, (False,), slope, values, (1.2, 1.0), "action", 1)


def _magnets(rng: Generator, b: float) -> OpenMechanism:
    """A body on a linear spring in the plane, above two or three attracting magnets."""
    count = int(rng.integers(2, 4))
    place, pull, above = rng.uniform(-0.8, 0.8, (count, 2)), rng.uniform(0.05, 0.3, count), between(rng, 0.3, 0.5)
    d = log_uniform(rng, 0.03, 0.15)
    values: Values = {"b": b, "above": above, "d": d, **{f"pull{j}": float(x) for j, x in enumerate(pull)}}

    def slope(q: Array, v: Array, w: Array, u: Array) -> tuple[Array, Array]:
        apart = q[:, None] - place  # (B, magnets, 2)
        near = (pull / (np.square(apart).sum(-1) + above**2) ** 1.5)[..., None]
        f = -q - (near * apart).sum(1) - d * v
        f[:, 0] += b * u
        return f, w

    return OpenMechanism("magnets", 2, (False, False), slope, values, (1.2, 0.6))


KINDS: dict[str, Callable[[Generator, float], OpenMechanism]] = {
    "bumps": _bumps, "ring": _ring, "springs": _springs, "linkage": _linkage, "length": _length, "herglotz": _herglotz,
    "magnets": _magnets,
}  # fmt: skip
