"""A printed equation, read as text and integrated: nothing here knows the model that it was printed for.

`Printed` makes functions of the lines; `integrated` follows them by Runge and Kutta's rule of order 4 with steps far
shorter than the samples', with set-valued friction by Moreau's, or by the steps that the text says.
"""

import re
from typing import Any

import numpy as np
from printed_text import NUMBER, Reader

RULES = {  # what `Printed.action` computes
    2: "L_d = (c − 1)(s − (h/2) V(q)) + √c h K − (h/2)(V(q) + V(q₊));",
    4: "L_d = (c − 1) s + √c (h K + (h³/24)(K_qq[v, v] + 2γ K_q v + γ² K − eᵀM⁻¹e)) − "
    "(h/6)(c V(q) + 4 √c V(q̄) + V(q₊)), e = K_q − V_q − K_qv v − γ K_v, M = K_vv;",
}
FAR = 1e6  # a motion beyond is lost


class Printed:
    """What a printed equation says: masses, forces and L as functions of q, v, s, u, and the words below it.

    Coordinates stand first, (n, ...): what follows are recordings, and points that differences need.
    """

    def __init__(self, text, names, inputs=()):
        self.names, self.n = names, len(names)
        joined, lines, functions, self.words = text.replace("\n    ", " ").split("\n"), {}, {}, ""
        for line in joined:
            left, _, right = line.partition(" = ")
            if re.fullmatch(r"L|force on .*|.*″", left) and left not in lines:
                lines[left] = right.partition(" and a network")[0]
            elif re.fullmatch(r"f\d+\(.*\)", left):
                functions[left] = right
            else:
                self.words += line + " "
        symbols = {f"{name}′": f"v[{i}]" for i, name in enumerate(names)}
        symbols |= {name: f"q[{i}]" for i, name in enumerate(names)}
        symbols |= {name: f"u[{j}]" for j, name in enumerate(inputs)}
        if "L" in lines:
            symbols["s"] = "s"
        for distance in re.findall(r"(\S+) = √\(", self.words):
            symbols[distance] = f"np.sqrt({'+'.join(f'q[{i}]**2' for i in range(self.n))})"
        symbols |= {name: f"({Reader(right, symbols).sum()})" for name, right in functions.items()}
        self.mass, forces = np.ones(self.n), ["0.0"] * self.n
        self.L: Any = None  # a function of q, v and s where one is printed, at the inputs u
        self.u: Any = np.zeros(len(inputs))
        of_q = list(forces)
        for left, right in lines.items():
            code = Reader(right, symbols)
            terms = code.terms()
            found = "".join(terms)
            assert code.at == len(right), f"not read: {right[code.at :]!r}"
            if left == "L":
                of_u = function(found, "q, v, s, u")
                self.L = lambda q, v, s, of_u=of_u: of_u(q, v, s, self.u)
                continue
            i = next(k for k, name in enumerate(names) if re.search(rf"(^| ){re.escape(name)}″?$", left))
            forces[i] = found
            beside = "[uv]" if "constants on angles among them" not in self.words else r"[uv]|^[-+]?[\d.]+(e[-+]?\d+)?$"
            of_q[i] = "".join(term for term in terms if not re.search(beside, term)) or "0.0"
            if (match := NUMBER.match(left)) and "″" in left:
                self.mass[i] = float(match[1] + (match[2] or ""))
        self.slope = None
        self.held = "stays 0" in self.words
        self.steps = float(self.said(r"steps are ([\d.e-]+)")) if "step it as" in self.words else None
        self.order = int(self.said(r"rule of order (\d)"))
        assert not self.steps or RULES[self.order] in self.words
        rate = re.search(r"γ = (−?[\d.e-]+), V", self.words)
        self.damps = 0.0 if rate is None else float(rate[1].replace("−", "-"))
        self._of_q = function(f"[{', '.join(of_q)}]", "q")
        slips = [re.sub(r"sgn\(v\[\d+\]\)", "0.0", force) if self.held else force for force in forces]
        self._force = function(f"[{', '.join(slips)}]", "q, v, u")
        self._grip = function(
            f"[{', '.join(grip(x, i) if self.held else '0.0' for i, x in enumerate(forces))}]", "q, v, u"
        )

    def said(self, pattern):
        """What stands in these words below the lines."""
        found = re.search(pattern, self.words)
        assert found is not None, f"{pattern} is not in {self.words!r}"
        return found[1]

    def force(self, q, v, u):
        """All forces but set-valued friction, (n, ...)."""
        return stacked(self._force(q, v, u), q)

    def grip(self, q, v, u):
        """What set-valued friction can hold, (n, ...)."""
        return np.maximum(stacked(self._grip(q, v, u), q), 0.0)

    def acceleration(self, q, v, s, u):
        """The second derivative of q, (n, ...), and s′, (...)."""
        self.u = u  # which does work in L where damping depends on s
        force = self.force(q, v, u)
        if self.L is None:
            return force / self.masses(q), np.zeros_like(s)
        tiny = 1e-5
        near = np.stack([q, q + tiny * v, q - tiny * v, q, q], 1)
        of_v, by_s, mass = self.slopes(
            near, spread(v, 5), s + np.array([0, 0, 0, 0.5, -0.5]).reshape(5, *(1,) * s.ndim)
        )
        of_q, rate = differences(lambda x: self.L(x, v[:, None], s), q), self.L(q, v, s) + 0 * s
        by_time = (of_v[:, 1] - of_v[:, 2]) / (2 * tiny) + (of_v[:, 3] - of_v[:, 4]) * rate
        return solved(mass[:, :, 0], of_q + by_s[0] * of_v[:, 0] + force - by_time), rate

    def slopes(self, q, v, s):
        """∂L/∂v, ∂L/∂s and ∂²L/∂v²: L is quadratic in v and a cubic of s, so that differences are exact."""
        n, unit = self.n, np.eye(self.n)
        moves = [unit[i] * x + unit[j] * y for i in range(n) for j in range(n) for x in (1, -1) for y in (1, -1)]
        moves = np.array([*unit, *-unit, *moves]).T.reshape(n, -1, *(1,) * (q.ndim - 1))
        L = self.L(q[:, None], v[:, None] + moves, s)
        L = np.broadcast_to(L, (moves.shape[1], *np.broadcast_shapes(q.shape[1:], v.shape[1:])))
        of_v, four = (L[:n] - L[n : 2 * n]) / 2, L[2 * n :].reshape(n, n, 4, *L.shape[1:])
        mass = (four[:, :, 0] - four[:, :, 1] - four[:, :, 2] + four[:, :, 3]) / 4
        near, far = (self.L(q, v, s + x) - self.L(q, v, s - x) for x in (0.5, 1.0))
        return of_v, (8 * near - far) / 6, mass

    def masses(self, q):
        """The masses of lines, shaped like q."""
        return self.mass.reshape(-1, *(1,) * (q.ndim - 1))

    def momentum(self, q, v, s):
        """The p of velocities v, (n, ...)."""
        return self.masses(q) * v if self.L is None else self.slopes(q, v, s)[0]

    def velocity(self, q, p, s):
        """The v of momenta p, (n, ...)."""
        return p / self.masses(q) if self.L is None else self.by_mass(q, p - self.momentum(q, 0 * q, s))

    def by_mass(self, q, e):
        """M⁻¹ e, (n, ...)."""
        return e / self.masses(q) if self.L is None else solved(self.slopes(q, 0 * q, 0 * q[0])[2], e)

    def potential(self, q):
        """V: what L is at rest, or the integral of the forces by position along a straight line."""
        if self.L is not None:
            return -self.L(q, 0 * q, 0 * q[0]) + 0 * q[0]
        x, w = NODES
        path = q[:, None] * ((x + 1) / 2).reshape(-1, *(1,) * (q.ndim - 1))
        return -np.tensordot(w / 2, (self.at_rest(path) * q[:, None]).sum(0), 1)

    def at_rest(self, q):
        """The forces by position, (n, ...)."""
        return stacked(self._of_q(q), q)

    def kinetic(self, q, v):
        """K: what of L is quadratic or linear in v."""
        if self.L is None:
            return (self.masses(q) * v * v).sum(0) / 2
        return self.L(q, v, 0 * q[0]) - self.L(q, 0 * v, 0 * q[0])

    def by_s(self, q, v, s):
        """∂L/∂s."""
        return -self.damps + 0 * s if self.L is None else self.L(q, v, s + 0.5) - self.L(q, v, s - 0.5)

    def beside(self, q, v, u):
        """f of the rule: the forces that are not those of L."""
        if self.L is not None:
            return self.force(q, v, u)
        return self.force(q, v, u) - self.at_rest(q) + self.damps * self.masses(q) * v

    def action(self, q0, q1, s, h):
        """L_d of the text, of order 2 or 4."""
        middle, v = (q0 + q1) / 2, (q1 - q0) / h
        rate = self.by_s(middle, v, s)
        c, V0, V1, K = np.exp(h * rate), self.potential(q0), self.potential(q1), self.kinetic(middle, v)
        if self.order == 2:
            return (c - 1) * (s - h / 2 * V0) + np.sqrt(c) * h * K - h / 2 * (V0 + V1)
        tiny = 1e-3
        ahead, behind = (self.kinetic(middle + d * v, v) for d in (tiny, -tiny))
        K_q, K_qq = (ahead - behind) / (2 * tiny), (ahead - 2 * K + behind) / tiny**2
        of_v = [self.momentum(middle + d * v, v, 0 * s) for d in (0.0, tiny, -tiny)]
        by_q = differences(lambda x: self.kinetic(x, v[:, None]) - self.potential(x), middle)
        e = by_q - (of_v[1] - of_v[2]) / (2 * tiny) + rate * of_v[0]
        bend = K_qq - 2 * rate * K_q + rate**2 * K - (e * self.by_mass(middle, e)).sum(0)
        simpson = h / 6 * (c * V0 + 4 * np.sqrt(c) * self.potential(middle) + V1)
        return (c - 1) * s + np.sqrt(c) * (h * K + h**3 / 24 * bend) - simpson


TINY = 1e-5
NODES = np.polynomial.legendre.leggauss(16)


def stacked(parts, like):
    """Numbers and arrays as one array that is shaped like another."""
    return np.stack([part + 0 * like[0] for part in parts])


def spread(x, count):
    return np.repeat(x[:, None], count, 1)


def solved(matrix, b):
    """M⁻¹ b of matrices (n, n, ...) and vectors (n, ...)."""
    return np.moveaxis(
        np.linalg.solve(np.moveaxis(matrix, (0, 1), (-2, -1)), np.moveaxis(b, 0, -1)[..., None])[..., 0], -1, 0
    )


def grip(force, i):
    """The factor of sgn(v_i) in a force, times −1."""
    slips, rests = (force.replace(f"sgn(v[{i}])", value) for value in ("1.0", "0.0"))
    return f"({rests})-({slips})"


def function(code, arguments):
    return eval(f"lambda {arguments}: {code}", {"np": np, "sgn": np.sign, "abs": np.abs})


def integrated(printed, t, q, p, s, u, parts=20):
    """Positions (B, N, n) at the times t (B, N) from q, p (B, n), s (B,), with inputs u(k, share), (m, B)."""
    q, s = q.T.copy(), s.copy()
    v, out = printed.velocity(q, p.T, s), [q.copy()]
    moves = discrete if printed.steps else moreau if printed.held else runge_kutta
    for k in range(t.shape[1] - 1):
        whole = t[:, k + 1] - t[:, k]
        count = max(1, round(float(np.median(whole)) / printed.steps)) if printed.steps else parts
        for part in range(count):
            h = whole / count
            now = lambda share, part=part, count=count, k=k: u(k, (part + share) / count)  # noqa: E731
            q, v, s = moves(printed, q, v, s, h, now)
        if not np.abs(q).max() < FAR:
            return np.full((*t.shape, len(q)), np.inf)
        out.append(q.copy())
    return np.stack(out, 1).transpose(2, 1, 0)


def runge_kutta(printed, q, v, s, h, u):
    def slope(dq, dv, ds, share):
        a, rate = printed.acceleration(q + dq, v + dv, s + ds, u(share))
        return v + dv, a, rate

    def beside(share, k):
        return slope(*(share * h * x for x in k), share)  # pyright: ignore[reportCallIssue]

    k1 = slope(0, 0, 0, 0.0)
    k2 = beside(0.5, k1)
    k3 = beside(0.5, k2)
    k4 = beside(1.0, k3)
    return tuple(x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip((q, v, s), k1, k2, k3, k4, strict=True))


def moreau(printed, q, v, s, h, u):
    """Half a drift, the other forces, dry friction up to rest, half a drift."""
    q = q + h / 2 * v
    middle = v + h / 2 * printed.acceleration(q, v, s, u(0.5))[0]
    v = v + h * printed.acceleration(q, middle, s, u(0.5))[0]
    most, push = h * printed.grip(q, v, u(0.5)), np.zeros_like(v)
    by_push = np.stack([printed.by_mass(q, 0 * q + e) for e in np.eye(len(q))[:, :, None]], 1)  # ∂v_i/∂push_j
    for i in (i for _ in range(1 if len(q) == 1 else 30) for i in range(len(q))):  # each up to rest, the others held
        new = np.clip(push[i] - v[i] / by_push[i, i], -most[i], most[i])
        v, push[i] = v + by_push[:, i] * (new - push[i]), new
    return q + h / 2 * v, v, s


def discrete(printed, q, v, s, h, u):
    """One step by the rule that the text has, from q, v = M⁻¹ p and s: L_d is differenced."""
    p, q1, end = printed.momentum(q, v, s), q + h * v, u(0.5)

    def forces(q1):
        return h / 2 * printed.beside((q + q1) / 2, (q1 - q) / h, end)

    def residual(q1, way):
        c, v = np.exp(h * printed.by_s((q + q1) / 2, (q1 - q) / h, s)), (q1 - q) / h
        held = h * printed.grip(q, v, end) * way
        return c * (p + forces(q1) - held) + differences(lambda x: printed.action(x, q1[:, None], s, h), q)

    push = residual(q, 0.0)
    way = np.sign(push)
    rests = np.abs(push) <= np.abs(push - residual(q, way))  # friction at rest holds so much
    assert len(q) == 1 or not rests.any(), "one coordinate alone rests"
    for turn in range(30):  # Newton's, with the derivatives of an earlier step while they serve
        if printed.slope is None or turn == 10:
            moves = TINY * np.eye(len(q))[:, :, None]
            printed.slope = np.stack([(residual(q1 + e, way) - residual(q1 - e, way)) / (2 * TINY) for e in moves], 1)
        move = solved(printed.slope, residual(q1, way))
        q1 = q1 - move
        if np.abs(move).max() < 1e-14 * np.abs(q1).max():
            break
    q1 = np.where(rests, q, q1)
    p1 = differences(lambda x: printed.action(q[:, None], x, s, h), q1) + forces(q1)
    s1 = s + printed.action(q, q1, s, h)
    return q1, printed.velocity(q1, p1, s1), s1


def differences(f, x, tiny=1e-3):
    """∂f/∂x by central differences of order 6; f is given all points at once, (n, 6n, ...)."""
    n = len(x)
    moves = tiny * np.array([k * e for e in np.eye(n) for k in (1, 2, 3, -1, -2, -3)]).T
    values = f(x[:, None] + moves.reshape(n, -1, *(1,) * (x.ndim - 1)))
    values = np.broadcast_to(values, (6 * n, *x.shape[1:])).reshape(n, 6, *x.shape[1:])
    one, two, three = (values[:, k] - values[:, k + 3] for k in range(3))
    return (45 * one - 9 * two + three) / (60 * tiny)
