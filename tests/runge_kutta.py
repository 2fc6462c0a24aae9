"""The classical Runge–Kutta rule: true motions that no code of the package has made."""


def step(rate, x, h):
    """A state after the time h, where ẋ = rate(x)."""
    a = rate(x)
    b = rate(x + h / 2 * a)
    c = rate(x + h / 2 * b)
    return x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))
