"""A printed equation, read as text and integrated: nothing here knows the model that it was printed for.

`read` makes functions of the lines; `integrated` follows them by Runge and Kutta's rule of order 4 with steps far
shorter than the samples', with set-valued friction by Moreau's, or by the steps that the text says.
"""

import re

import numpy as np

POWERS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
NUMBER = re.compile(r"(\d+(?:\.\d+)?)(?:\((?:±)?[\d.e+-]+\))?(e[-+]?\d+)?")
POWER = re.compile(r"[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")
FUNCTIONS = {"sin": "np.sin", "cos": "np.cos", "tanh": "np.tanh", "exp": "np.exp", "sgn": "sgn", "√": "np.sqrt"}
SIGNS = {"+": "+", "−": "-"}
FAR = 1e6  # a motion beyond is lost


class Reader:
    """Python text of a sum of products, by recursive descent."""

    def __init__(self, text, symbols):
        self.text, self.at = text, 0
        self.words = sorted((FUNCTIONS | symbols).items(), key=lambda pair: -len(pair[0]))

    def skip(self):
        while self.text[self.at : self.at + 1] == " ":
            self.at += 1

    def take(self, mark):
        self.skip()
        found = self.text.startswith(mark, self.at)
        self.at += len(mark) * found
        return found

    def sum(self, closed=""):
        found, sign = "", next((s for mark, s in SIGNS.items() if self.take(mark)), "")
        while True:
            found += sign + self.product(closed)
            sign = next((s for mark, s in SIGNS.items() if self.take(mark)), None)
            if sign is None:
                return found

    def product(self, closed):
        found = []
        while True:
            self.skip()
            rest = self.text[self.at : self.at + 1]
            if not rest or rest in "+−)" or (rest == "|" and closed == "|" and found):
                return "*".join(found)
            if self.take("/"):
                found[-1] = f"({found[-1]})/({self.factor()})"
            else:
                found.append(self.factor())

    def factor(self):
        self.skip()
        base = self.base()
        if match := POWER.match(self.text, self.at):
            self.at = match.end()
            return f"({base})**({float(match[0].translate(POWERS))})"
        return base

    def base(self):
        for name, code in self.words:
            if not self.text.startswith(name, self.at):
                continue
            self.at += len(name)
            if name not in FUNCTIONS:
                return code
            self.skip()
            return f"{code}({self.inside() if self.text[self.at] == '(' else self.base()})"
        if match := NUMBER.match(self.text, self.at):
            self.at = match.end()
            return match[1] + (match[2] or "")
        if self.take("|"):
            inside = self.sum("|")
            assert self.take("|"), self.text
            return f"abs({inside})"
        return f"({self.inside()})"

    def inside(self):
        assert self.take("("), f"{self.text!r} from {self.text[self.at :]!r}"
        found = self.sum()
        assert self.take(")"), self.text
        return found


class Printed:
    """What a printed equation says: masses, forces and L as functions of q, v, s, u, and the words below it."""

    def __init__(self, text, names, inputs=()):
        self.names, n = names, len(names)
        joined, lines = text.replace("\n    ", " ").split("\n"), {}
        self.words = ""
        for line in joined:
            left, _, right = line.partition(" = ")
            if re.fullmatch(r"L|force on .*|.*″", left) and left not in lines:
                lines[left] = right.partition(" and a network")[0]
            else:
                self.words += line + " "
        symbols = {f"{name}′": f"v[{i}]" for i, name in enumerate(names)}
        symbols |= {name: f"q[{i}]" for i, name in enumerate(names)}
        symbols |= {name: f"u[{j}]" for j, name in enumerate(inputs)}
        if "L" in lines:
            symbols["s"] = "s"
        for distance in re.findall(r"(\S+) = √\(", self.words):
            symbols[distance] = f"np.sqrt({'+'.join(f'q[{i}]**2' for i in range(n))})"
        self.masses, self.forces, self.factors, self.L = [1.0] * n, ["0.0"] * n, ["0.0"] * n, None
        for left, right in lines.items():
            code = Reader(right, symbols)
            found = code.sum()
            assert code.at == len(right), f"not read: {right[code.at :]!r}"
            if left == "L":
                self.L = function(found, "q, v, s")
                continue
            i = next(k for k, name in enumerate(names) if re.search(rf"(^| ){re.escape(name)}″?$", left))
            self.forces[i] = found
            if "″" in left and (match := NUMBER.match(left)) and match[0] != names[i]:
                self.masses[i] = float(match[1] + (match[2] or ""))
        self.held = "stays 0" in self.words
        self.steps = float(re.search(r"steps are ([\d.e-]+)", self.words)[1]) if "step it as" in self.words else None
        self.damps = float(re.search(r"γ = (\S+)", self.words)[1].replace("−", "-")) if self.steps else 0.0
        self.factors = [grip(force, i) for i, force in enumerate(self.forces)] if self.held else ["0.0"] * n
        smooth = [re.sub(r"sgn\(v\[\d+\]\)", "0.0", force) if self.held else force for force in self.forces]
        self.force = function(f"[{', '.join(smooth)}]", "q, v, u")
        self.grip = function(f"[{', '.join(self.factors)}]", "q, v, u")

    def acceleration(self, q, v, s, u):
        """(n, B) and s′ (B,)."""
        force = np.stack(np.broadcast_arrays(*self.force(q, v, u), q[0])[:-1])
        if self.L is None:
            return force / np.array(self.masses)[:, None], np.zeros_like(s)
        _, of_v, by_s, mass = self.slopes(q, v, s)
        of_q, tiny = self.by_q(q, v, s), 1e-5
        ahead, behind = (self.slopes(q + d * v, v, s)[1] for d in (tiny, -tiny))
        rate = self.L(q, v, s)
        by_time = (ahead - behind) / (2 * tiny) + (self.slopes(q, v, s + 0.5)[1] - self.slopes(q, v, s - 0.5)[1]) * rate
        push = of_q + by_s * of_v + force - by_time
        return np.linalg.solve(np.moveaxis(mass, -1, 0), push.T[..., None])[..., 0].T, rate

    def slopes(self, q, v, s):
        """L, ∂L/∂v and ∂L/∂s, and ∂²L/∂v²: L is quadratic in v and linear in s, so that differences are exact."""
        n, unit = len(q), np.eye(len(q))[:, :, None]
        of_v = np.stack([(self.L(q, v + e, s) - self.L(q, v - e, s)) / 2 for e in unit])
        mass = np.empty((n, n, q.shape[1]))
        for i in range(n):
            for j in range(n):
                a, b = unit[i], unit[j]
                four = [self.L(q, v + x * a + y * b, s) for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
                mass[i, j] = (four[0] - four[1] - four[2] + four[3]) / 4
        return self.L(q, v, s), of_v, self.L(q, v, s + 0.5) - self.L(q, v, s - 0.5), mass

    def by_q(self, q, v, s):
        """∂L/∂q by central differences of order 4."""
        tiny, found = 1e-3, []
        for e in np.eye(len(q))[:, :, None]:
            one, two = (self.L(q + k * tiny * e, v, s) - self.L(q - k * tiny * e, v, s) for k in (1, 2))
            found.append((8 * one - two) / (12 * tiny))
        return np.stack(found)

    def velocity(self, q, p, s):
        """The v of momenta p, (n, B)."""
        if self.L is None:
            return p / np.array(self.masses)[:, None]
        _, of_v, _, mass = self.slopes(q, 0 * q, s)
        return np.linalg.solve(np.moveaxis(mass, -1, 0), (p - of_v).T[..., None])[..., 0].T


def grip(force, i):
    """The factor of sgn(v_i) in a force, times −1."""
    slips, rests = (force.replace(f"sgn(v[{i}])", value) for value in ("1.0", "0.0"))
    return f"({rests})-({slips})"


def function(code, arguments):
    return eval(f"lambda {arguments}: {code}", {"np": np, "sgn": np.sign, "abs": np.abs})


def integrated(printed, t, q, p, s, u, parts=20):
    """Positions (B, N, n) at the times t (B, N) from q, p (B, n), s (B,), with inputs u (t, k) → (m, B) or None."""
    q, s = q.T.copy(), s.copy()
    v, out = printed.velocity(q, p.T, s), [q.copy()]
    moves = moreau if printed.held else leapfrog if printed.steps else runge_kutta
    for k in range(t.shape[1] - 1):
        whole = t[:, k + 1] - t[:, k]
        count = max(1, round(float(np.median(whole)) / printed.steps)) if printed.steps else parts
        for part in range(count):
            h = whole / count
            now = lambda share, part=part, count=count, k=k: u(k, (part + share) / count)  # noqa: E731
            q, v, s = moves(printed, q, v, s, h, now)
        if not np.abs(q).max() < FAR:
            return np.full((t.shape[0], t.shape[1], len(q)), np.inf)
        out.append(q.copy())
    return np.stack(out, 1).transpose(2, 1, 0)


def runge_kutta(printed, q, v, s, h, u):
    def slope(dq, dv, ds, share):
        a, rate = printed.acceleration(q + dq, v + dv, s + ds, u(share))
        return v + dv, a, rate

    k1 = slope(0, 0, 0, 0.0)
    k2 = slope(*(h / 2 * x for x in k1), 0.5)
    k3 = slope(*(h / 2 * x for x in k2), 0.5)
    k4 = slope(*(h * x for x in k3), 1.0)
    return tuple(x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip((q, v, s), k1, k2, k3, k4, strict=True))


def moreau(printed, q, v, s, h, u):
    """Half a drift, the other forces, dry friction up to rest, half a drift."""
    q, mass = q + h / 2 * v, np.array(printed.masses)[:, None]
    middle = v + h / 2 * printed.acceleration(q, v, s, u(0.5))[0]
    v = v + h * printed.acceleration(q, middle, s, u(0.5))[0]
    held = np.maximum(np.stack(np.broadcast_arrays(*printed.grip(q, v, u(0.5)), q[0])[:-1]), 0.0) * h / mass
    v = np.sign(v) * np.maximum(np.abs(v) - held, 0.0)
    return q + h / 2 * v, v, s


def leapfrog(printed, q, v, s, h, u):
    """As the text says: m v = (p + (h/2) f(q, v)) exp(−γ h/2), q₊ = q + h v, p₊ = m v exp(−γ h/2) + (h/2) f(q₊, v)."""
    mass, decay, x = np.array(printed.masses)[:, None], np.exp(-printed.damps * h / 2), v

    def force(at, middle, x):
        """Products of q and v are those in the middle, what depends on q alone is at the end of the step."""
        friction = acceleration(middle, x) - acceleration(middle, 0 * x) + printed.damps * x
        return mass * (acceleration(at, 0 * x) + friction)

    def acceleration(q, v):
        return printed.acceleration(q, v, s, u(0.5))[0]

    for _ in range(60):
        x = (v + h / 2 * force(q, q + h / 2 * x, x) / mass) * decay
    return q + h * x, x * decay + h / 2 * force(q + h * x, q + h / 2 * x, x) / mass, s
