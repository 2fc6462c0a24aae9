"""Affine point symmetries found from L_d alone, and their dissipated quantities J_{k+1} = c_k J_k."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import partials
from herglotz.stepping import State, Stepper
from herglotz.theory import noether_defect, symmetries
from herglotz.theory.symmetry_words import formula, name_of

F64 = torch.float64
H = 0.1


def lagrangian(V, gamma=0.0, masses: float | torch.Tensor = 1.0, magnetic=None):
    """h (K + A·v) − (h/2)(V0 + V1) − (1 − e^{−γh}) s0, for V(q) and A·v = magnetic(q̄, v)."""

    def L_d(q0, q1, s0, h):
        v, middle = (q1 - q0) / h, 0.5 * (q0 + q1)
        L = 0.5 * (masses * v * v).sum(-1) - 0.5 * (V(q0) + V(q1))
        L = L if magnetic is None else L + magnetic(middle, v)
        return h * L + torch.expm1(-gamma * torch.as_tensor(h, dtype=q0.dtype)) * s0

    return L_d


def regauged(L_d, F):
    """The same motions with the action s + F(q)."""
    return lambda q0, q1, s0, h: L_d(q0, q1, s0 - F(q0), h) + F(q1) - F(q0)


def nothing(q):
    return 0.0 * q.sum(-1)


def springs(q):
    d = q.diff()
    return (0.5 * d**2 + 0.25 * d**4).sum(-1)


def symmetric_gauge(q, v):
    return 0.85 * (q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0])


def landau_gauge(q, v):
    return 1.7 * q[..., 0] * v[..., 1]


def states(n, count=24, seed=0, at: float | torch.Tensor = 0.0):
    make = torch.Generator().manual_seed(seed)
    q, p = (torch.randn(count, n, generator=make, dtype=F64) for _ in range(2))
    return State(at + q, p, torch.rand(count, generator=make, dtype=F64) - 0.5)


SCALING = "scaling of q, and of s by its square"
PLANE = "rotation in the plane (q1, q2)"
CASES = {  # name → L_d, coordinates, what there is to find
    "free chain with damping": (lagrangian(springs, 0.3), 4, {"translation of q1, q2, q3 and q4 together"}),
    "the same with s + 0.7 q1²": (  # χ = 1.4 q1 beside a c that is not 1
        regauged(lagrangian(springs, 0.3), lambda q: 0.7 * q[..., 0] ** 2),
        4,
        {"translation of q1, q2, q3 and q4 together"},
    ),
    "free chain": (lagrangian(springs), 3, {"translation of q1, q2 and q3 together"}),
    "chain at a wall": (lagrangian(lambda q: springs(q) + 0.5 * q[..., 0] ** 2 + q[..., 0] ** 4, 0.3), 3, set()),
    "charged particle": (
        lagrangian(nothing, magnetic=symmetric_gauge),
        2,
        {"translation along q1", "translation along q2", PLANE, SCALING},
    ),
    "charged particle in Landau's gauge": (
        lagrangian(nothing, magnetic=landau_gauge),
        2,
        {"translation along q1", "translation along q2", PLANE, SCALING},
    ),
    # γ damps p = v + A, not v: the friction γ A(q) knows where the axis of A is
    "damped charged particle": (lagrangian(nothing, 0.4, magnetic=symmetric_gauge), 2, {PLANE, SCALING}),
    "fall with drag": (
        lagrangian(lambda q: 9.81 * q[..., 1], 0.3),
        2,
        {"translation along q1", "translation along q2"},
    ),
    "fall": (lagrangian(lambda q: 9.81 * q[..., 1]), 2, {"translation along q1"}),  # J of q2 needs −mgt: time enters
    "two masses in a plane": (
        lagrangian(nothing, 0.2, torch.tensor([1.0, 1.4], dtype=F64)),
        2,
        {"translation along q1", "translation along q2", SCALING, "elliptic rotation in the plane (q1, q2)"},
    ),
    "a bowl not at the origin": (
        lagrangian(lambda q: ((q - torch.tensor([0.5, -2.0])) ** 2).sum(-1) ** 2, 0.1),
        2,
        {PLANE + " about (0.5, -2)"},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_what_there_is_is_found_and_nothing_else(name):
    # fails if a column of the linear problem is wrong, a boundary term is left out, or the basis is not reduced
    L_d, n, expected = CASES[name]
    found = symmetries(L_d, states(n), H, steps=25)
    assert set(found.names) == expected
    assert len(found.names) == len(expected)
    assert bool((found.drift < 1e-11).all())  # measured ≤ 3e-15
    assert found.gap > 1e5  # the best other direction drifts by 1e-3 and more
    assert found.unseen == 0
    # fails if χ or a of a generator is not the one of its ξ, or a centre is not taken back: J along other motions
    q, p, s = states(n, 7, seed=5, at=1.3)
    step = Stepper(L_d).step(State(q, p, s), H)
    for i in range(len(found)):
        J = lambda q, p, s, i=i: found.momentum(q, p, s)[..., i]  # noqa: E731
        size = float(J(q, p, s).abs().max()) + float((p * found.generator(q)[..., i, :]).abs().sum(-1).max())
        assert float(noether_defect(J, (q, p, s), step.state, step.c).abs().max()) < 1e-12 * size  # measured 2e-14


def test_a_small_break_is_no_symmetry_but_within_its_precision():
    # fails if the precision is not compared with the drift, or the drift shrinks with the step
    broken = lagrangian(lambda q: springs(q) + 1e-6 * q[..., 0] ** 2, 0.3)
    assert len(symmetries(broken, states(3), H, steps=25)) == 0
    found = symmetries(broken, states(3), H, steps=25, precision=1e-3)
    assert found.names == ("translation of q1, q2 and q3 together",)
    assert 1e-7 < float(found.drift[0]) < 1e-5
    finer = symmetries(broken, states(3), H / 4, steps=100, precision=1e-3)
    assert abs(float(finer.drift[0]) / float(found.drift[0]) - 1) < 0.3


def test_the_drift_is_that_of_J_along_the_motions():
    # fails if a step is left out of the sums, or they do not shrink by c: J_k − σ_k J_0 from p, q, s of a rollout
    broken = lagrangian(lambda q: springs(q) + 0.1 * q[..., 0] ** 2, 0.8)
    found = symmetries(broken, states(2), H, steps=25, precision=10.0, angles=(True, True))
    out = Stepper(broken).rollout(*states(2), h=H, steps=25)
    J = found.momentum(out.q, out.p, out.s)
    left = (J - out.sigma[..., None] * J[:, :1])[:, 1:]
    size = (out.p @ found.b.mT)[:, 1:]
    expected = left.square().mean((0, 1)).sqrt() / (size - size.mean((0, 1))).square().mean((0, 1)).sqrt()
    moved = found.a == 0
    assert int(moved.sum()) == 2
    torch.testing.assert_close(found.drift[moved], expected[moved], rtol=1e-6, atol=0)


def test_a_gauge_does_not_change_the_drift():
    # fails if the size is that of p, which a boundary term shifts: L_d + w·(q1 − q0) moves alike
    broken = lagrangian(lambda q: springs(q) + 1e-3 * q[..., 0] ** 2)
    w = torch.tensor([50.0, -20.0], dtype=F64)
    gauged = lambda q0, q1, s0, h: broken(q0, q1, s0, h) + (q1 - q0) @ w  # noqa: E731
    q, p, s = states(2)
    one, other = (
        symmetries(L_d, x, H, steps=25, precision=0.05) for L_d, x in ((broken, (q, p, s)), (gauged, (q, p + w, s)))
    )
    assert one.names == other.names == ("translation of q1 and q2 together",)
    torch.testing.assert_close(one.drift, other.drift, rtol=1e-6, atol=0)


def test_an_angle_is_only_translated():
    # fails if ξ or χ depends on an angle: the free rotor would be scaled, and a torque would be a boundary term
    rotor = lagrangian(nothing, 0.2)
    assert set(symmetries(rotor, states(1), H, steps=20).names) == {"translation along q1", SCALING}
    found = symmetries(rotor, states(1), H, steps=20, angles=(True,), coordinates=("theta",))
    assert found.names == ("translation along theta",)
    mixed = symmetries(lagrangian(lambda q: q[..., 1] ** 4, 0.2), states(2), H, steps=20, angles=(True, False))
    assert mixed.names == ("translation along q1",)


def test_far_from_the_origin():
    # fails if columns are not taken about the middle of the motions: q² is 1e10 there
    far = torch.tensor([1e5, -2e5], dtype=F64)
    found = symmetries(lagrangian(lambda q: ((q - far) ** 2).sum(-1) ** 2, 0.1), states(2, at=far), H, steps=25)
    assert found.names == (PLANE + " about (1e+05, -2e+05)",)


def test_single_precision():
    # fails if rounding of float32 is judged as that of float64
    L_d, n, expected = CASES["free chain with damping"]
    found = symmetries(L_d, State(*(x.float() for x in states(n))), H, steps=25)
    assert set(found.names) == expected
    assert found.precision == 1e-4


def test_directions_that_the_motions_do_not_show_are_counted():
    # fails if a direction without motion is taken for a symmetry: both coordinates move alike here
    q, p, s = states(1)
    found = symmetries(lagrangian(lambda q: (q**4).sum(-1), 0.1), (q.expand(-1, 2), p.expand(-1, 2), s), H, steps=25)
    assert len(found) == 0
    assert found.unseen == 4
    assert "4 directions are not determined" in str(found)


def test_forces_act_beside_the_symmetry():
    # fails if forces are counted as a break of L_d: J_{k+1} = c J_k + F⁻·ξ(q0) + F⁺·ξ(q1)
    class Rubbed:
        def __call__(self, q0, q1, s0, h):
            return lagrangian(springs, 0.3)(q0, q1, s0, h)

        def forces(self, q0, q1, s0, h):  # noqa: ARG002
            f = torch.stack([-0.4 * (q1 - q0)[..., 0], torch.sin(q0[..., 1])], -1)
            return 0.5 * h * f, 0.5 * h * f

    found = symmetries(Rubbed(), states(2), H, steps=25)
    assert found.names == ("translation of q1 and q2 together",)
    q, p, s = states(2, 5, seed=3)
    step = Stepper(Rubbed()).step(State(q, p, s), H)
    force = partials(Rubbed(), q, step.state.q, s, H).force
    assert force is not None
    power = ((force.minus + force.plus) * found.b).sum(-1)
    change = found.momentum(*step.state)[:, 0] - step.c * found.momentum(q, p, s)[:, 0]
    torch.testing.assert_close(change, power, rtol=0, atol=1e-13)


def test_what_is_printed():
    # fails if a word, a sign or a factor of the printed J is wrong
    text = str(symmetries(CASES["fall with drag"][0], states(2), H, steps=25))
    assert text.startswith("affine point symmetries: 2")
    assert f"translation along q2: J = p_q2 + {9.81 * H / (1 - 2.718281828459045 ** (-0.3 * H)):.4g}, drift" in text
    none = str(symmetries(CASES["chain at a wall"][0], states(3), H, steps=25))
    assert none.startswith("affine point symmetries: none")
    assert "the best other direction drifts by" in none
    zero, one = torch.zeros(2, dtype=F64), torch.eye(2, dtype=F64)
    turn = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=F64)
    names = ("x", "y")
    assert name_of(0 * one, torch.tensor([0.6, 0.8], dtype=F64), 0.0, names) == "translation along (0.6, 0.8)"
    assert name_of(turn, zero, 0.0, names) == "rotation in the plane (x, y)"
    assert name_of(turn, torch.tensor([-3.0, 1.0], dtype=F64), 0.0, names).endswith("about (-1, -3)")
    assert name_of(0.5 * one + turn, zero, 1.5, names) == "affine motion x′ = 0.5 x − y, y′ = x + 0.5 y, s′ = 1.5 s"
    assert name_of(one, zero, 2.0, names) == SCALING
    B = torch.tensor([[2.0, 0.3], [0.3, 0.0]], dtype=F64)
    J = formula((turn, zero, torch.tensor(2.0)), (torch.tensor(-4.0), torch.tensor([0.5, 0.0]), B), names)
    assert J == "x p_y − y p_x − 2 s − 0.5 x − x² − 0.3 x y + 4"
    noisy = ((0 * one, one[0], torch.tensor(0.0)), (torch.tensor(0.0), torch.tensor([2e-3, -0.4]), 0 * one), names)
    assert formula(*noisy) == "p_x − 0.002 x + 0.4 y"
    assert formula(*noisy, drift=3e-4) == "p_x + 0.4 y"  # fails if terms below the drift of J are written


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"states": (torch.ones(3), torch.ones(3), torch.ones(3))}, r"states need shapes \(B, n\)"),
        ({"angles": (True,)}, "angles needs one entry a coordinate"),
        ({"coordinates": ("x",)}, "coordinates needs one entry a coordinate"),
        ({"states": states(2, 1), "steps": 5}, "5 steps do not determine 13 numbers"),
        ({"states": tuple(torch.nan * x for x in states(2, 3))}, "no motion could be stepped|finite"),
    ],
)
def test_what_is_refused(change, message):
    # fails if a wrong shape or too few motions go through
    settings = {"states": states(2), "steps": 10, **change}
    with pytest.raises(InputError, match=message):
        symmetries(lagrangian(springs), settings.pop("states"), H, **settings)
