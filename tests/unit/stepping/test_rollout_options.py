"""Inputs, decimation, chunks and checkpoints of a rollout."""

from typing import Any, cast

import pytest
import torch

from herglotz.errors import InputError
from herglotz.models import ModelConfig
from herglotz.stepping import State, Status, StepError, Stepper
from herglotz.stepping.rollout import EQUAL, Extrapolation, extrapolation_weights
from tests.lagrangians import random_model


class Motor:
    """A pendulum with a torque u: L_d^k, an Euler rule with V(q) − u q."""

    def __init__(self, u=None):
        self.u = u

    def at(self, u):
        return Motor(u)

    def __call__(self, q0, q1, s0, h):
        K = ((q1 - q0) ** 2).sum(-1) / (2 * h)
        work = 0.0 if self.u is None else (self.u * q0).sum(-1)
        return K + h * (torch.cos(q0).sum(-1) + work - 0.1 * s0)


def model(**settings):
    return random_model(ModelConfig(**settings), spread=0.2, seed=1)


def start(batch=3):
    q = torch.linspace(-1, 1, batch, dtype=torch.float64)[:, None]
    return State(q, torch.cos(q), torch.zeros(batch, dtype=torch.float64))


def saved_bytes(make):
    """Bytes that the graph of make() keeps for its backward pass."""
    total = [0]

    def pack(x):
        total[0] += x.numel() * x.element_size()
        return x

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        make()
    return total[0]


def test_inputs_reach_their_own_step():
    # fails if inputs are ignored, shifted by a step, or shared by a batch that has different inputs
    inputs = torch.randn(3, 6, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    stepper, state = Stepper(Motor()), start()
    out = stepper.rollout(*state, h=0.1, inputs=inputs)
    for k in range(6):
        state = stepper.step(state, 0.1, u=inputs[:, k]).state
        torch.testing.assert_close(out.q[:, k + 1], state.q, rtol=1e-12, atol=1e-13)
    shared = stepper.rollout(*start(), h=0.1, inputs=inputs[0])
    torch.testing.assert_close(shared.q[0], out.q[0], rtol=1e-13, atol=1e-13)
    assert float((shared.q[1] - out.q[1]).abs().max()) > 1e-3
    by_hand = Stepper(Motor(inputs[:, 2])).init(out.q[:, 2], out.q[:, 3], out.s[:, 2], 0.1)
    torch.testing.assert_close(tuple(stepper.init(out.q[:, 2], out.q[:, 3], out.s[:, 2], 0.1, inputs[:, 2])), by_hand)
    torch.testing.assert_close(tuple(by_hand), (out.q[:, 3], out.p[:, 3], out.s[:, 3]), rtol=1e-12, atol=1e-12)


def test_gradients_with_respect_to_inputs():
    # fails if u is cut off from the solve, in the implicit or the explicit step
    forced = model(level="forced", inputs=2)
    for L_d, m in ((Motor(), 1), (forced, 2)):
        inputs = torch.randn(4, m, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
        state, stepper = start(2), Stepper(L_d)
        assert torch.autograd.gradcheck(lambda u, a=stepper, x=state: a.rollout(*x, h=0.2, inputs=u).q, [inputs])


@pytest.mark.parametrize("explicit", [True, False])
def test_every_and_chunk_keep_the_same_states(explicit):
    # fails if a kept state is off by one, a segment loses its trail, or a status is that of the last step only
    stepper, h = Stepper(model(), explicit=explicit), torch.linspace(0.05, 0.3, 12, dtype=torch.float64)
    with torch.no_grad():
        full = stepper.rollout(*start(), h=h)
        for every, chunk in ((1, 5), (3, 4), (4, 1), (12, 1024), (2, 12)):
            some = stepper.rollout(*start(), h=h, every=every, chunk=chunk)
            assert some.status.shape == (3, 12 // every)
            worst = full.residual.unflatten(-1, (-1, every)).amax(-1)
            torch.testing.assert_close(some.residual, worst, rtol=0, atol=0)
            for name, axis in (("q", -2), ("p", -2), ("s", -1), ("sigma", -1)):
                kept = getattr(full, name).index_select(axis, torch.arange(0, 13, every))
                torch.testing.assert_close(getattr(some, name), kept, rtol=1e-13, atol=1e-13)
    for chunk, checkpoint in ((4, None), (1024, 4)):
        with_graph = stepper.rollout(*start(), h=h, every=3, chunk=chunk, checkpoint=checkpoint)
        torch.testing.assert_close(with_graph.q.detach(), full.q[:, ::3], rtol=1e-13, atol=1e-13)
        assert with_graph.status.shape == (3, 4)


def test_a_failure_between_kept_states_is_reported():
    # fails if `every` hides the status of a step that is not kept
    def cliff(q0, q1, s0, h):
        # No inertia beyond the cliff.
        return torch.where(q0 < 0.35, (q1 - q0) ** 2 / (2 * h), q0 * 0).sum(-1) + 0 * s0

    q = torch.tensor([[0.0], [-5.0]], dtype=torch.float64)
    out = Stepper(cliff).rollout(q, torch.ones_like(q), h=0.1, steps=6, every=3)
    assert out.status.tolist() == [[Status.CONVERGED, Status.SINGULAR], [0, 0]] or out.status[0, 1] != 0
    assert bool(out.q[0, 2].isnan().all())
    assert out.ok.tolist() == [False, True]
    with pytest.raises(StepError, match=r"step 4: step failed at sample \(0,\)"):
        Stepper(cliff, throw=True).rollout(q, torch.ones_like(q), h=0.1, steps=6)


@pytest.mark.parametrize("settings", [{}, {"correction_width": 4, "level": "affine"}])
def test_checkpointing_gives_the_same_gradient_with_less_memory(settings):
    # fails if a segment is recomputed from another start, or keeps the graph of its inner steps
    made, steps = model(**settings), 48
    leaves = [x.requires_grad_() for x in (*start(), torch.tensor(0.1, dtype=torch.float64))]

    def value(**options):
        out = Stepper(made).rollout(*leaves[:3], h=leaves[3], steps=steps, **options)
        return (out.q.sum((0, 2)) * torch.linspace(0, 1, out.q.shape[1]).double()).sum() + out.s[:, -1].sum()

    wanted = [*leaves, *(w for w in made.parameters() if w.numel())]
    plain, cut = (torch.autograd.grad(value(**o), wanted, allow_unused=True) for o in ({}, {"checkpoint": 7}))
    for a, b in zip(plain, cut, strict=True):
        if a is not None or b is not None:
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
    thin, kept = (saved_bytes(lambda o=o: value(every=8, **o)) for o in ({"checkpoint": 8}, {}))
    assert thin < kept / 20


def test_extrapolation_is_exact_for_cubics():
    # fails if a weight belongs to another position, or equal steps have other constants than Lagrange's
    h = torch.tensor([0.1, 0.3, 0.2, 0.15, 0.4, 0.1], dtype=torch.float64)
    t = torch.cat([torch.zeros(1).double(), h.cumsum(0)])
    q = (1 + t - 2 * t**2 + t**3)[:, None]
    guess = Extrapolation(h)
    for k in range(3, 6):
        trail = tuple(q[k - 3 : k + 1])
        torch.testing.assert_close(guess(trail, k), q[k + 1], rtol=1e-12, atol=1e-12)
    for count, weights in EQUAL.items():
        lagrange = extrapolation_weights(torch.full((count,), 0.3, dtype=torch.float64), count)
        torch.testing.assert_close(lagrange, torch.tensor(weights, dtype=torch.float64), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s, x: s.rollout(*x, h=0.1), "a scalar h needs steps >= 1"),
        (lambda s, x: s.rollout(*x, h=torch.ones(3), steps=4), "h lists 3 steps but steps=4"),
        (lambda s, x: s.rollout(*x, h=0.1, steps=4, inputs=torch.ones(4, 1)), "takes no inputs: it has no method"),
        (lambda s, x: s.step(x, 0.1, u=torch.ones(1)), "takes no inputs"),
        (lambda s, x: s.init(x.q, x.q, u=torch.ones(1)), "takes no inputs"),
        (lambda s, x: s.rollout(*x, h=0.1, steps=4, every=3), "every=3 does not divide the number of steps 4"),
        (lambda s, x: s.rollout(*x, h=0.1, steps=4, every=0), "every must be a whole number >= 1, got 0"),
        (lambda s, x: s.rollout(*x, h=0.1, steps=4, checkpoint=0), "checkpoint must be a whole number >= 1, got 0"),
        (lambda _, x: Stepper(Motor()).rollout(*x, h=0.1, inputs=torch.ones(4)), r"shape \(K, m\) or"),
        (lambda s, x: s.rollout(x, h=0.1, steps=4), r"q must be a tensor, got a State; .* \(\*state, h=h\)"),
        (lambda s, x: s.rollout(x.q[:, :0], x.p, h=0.1, steps=4), r"q needs shape \(..., n\), got \(3, 0\)"),
        (lambda s, x: s.rollout(*x, h=0.1, steps=4, every="2"), "every must be a whole number >= 1, got '2'"),
        (lambda s, x: s.rollout(*x, h=0.1, steps=4, chunk=None), "chunk must be a whole number >= 1, got None"),
        (lambda s, x: s.rollout(*x, h=0.1, steps=4, events=len), r"got a builtin.*write events=\[...\]"),
        (lambda _, x: Stepper(Motor()).rollout(*x, h=0.1, inputs=cast(Any, "u")), r"inputs must be numbers .* got 'u'"),
        (lambda s, _: s.init([1.0], [1.0], h=0.1), "q0 must be a tensor, got a list"),
        (lambda s, x: s.init(x.s[0], x.s[0], h=0.1), r"q0 needs shape \(..., n\), got \(\)"),
        (lambda s, x: s.init_qv(x.q.numpy(), x.p.numpy(), h=0.1), "q must be a tensor, got a ndarray"),
        (lambda s, x: s.init_qv(x.q, 1.0, h=0.1), "v must be a tensor, got a float"),
        (lambda s, x: s.init_qv(x.q, x.p, h=[0.1, 0.2]), "does not spread"),
        (lambda s, x: s.step(x.q, 0.1), r"a state is State\(q, p, s\), got a Tensor; .*\.final"),
        (lambda s, x: s.velocity(s.rollout(*x, h=0.1, steps=2), 0.1), r"got a Rollout; .*\.final"),
        (lambda s, x: s.linearise((x.q, x.p), 0.1), r"a state is State\(q, p, s\), got a tuple"),
        (lambda s, x: s.step(x, 0.1, guess=x.q.numpy()), "guess must be a tensor, got a ndarray"),
        (lambda s, x: s.step(x, 0.1, guess=x.q[:1]), r"guess needs the shape of q, \(3, 1\), got \(1, 1\)"),
        (
            lambda s, _: Stepper(s.L_d, max_iterations=cast(Any, 2.5)),
            r"max_iterations must be a whole number >= 1, got 2\.5",
        ),
        (lambda s, _: Stepper(s.L_d, tol=cast(Any, "a")), "tol must be a number > 0, got 'a'"),
        (
            lambda _, x: Stepper(Motor()).rollout(*x, h=0.1, steps=5, inputs=torch.ones(4, 1)),
            "inputs list 4 steps, but the rollout has 5",
        ),
    ],
)
def test_wrong_options_are_named(call, message):
    # fails if a wrong call reaches the solver
    def plain(q0, q1, s0, h):
        return ((q1 - q0) ** 2).sum(-1) / (2 * h) - 0.1 * h * s0

    with pytest.raises(InputError, match=message):
        call(Stepper(plain), start())


def test_steps_of_a_start_spread_over_its_parts():  # fails if p has another batch than q, or q another dtype than s
    def plain(q0, q1, s0, h):
        return ((q1 - q0) ** 2).sum(-1) / (2 * h) - 0.1 * h * s0

    s, q, h = Stepper(plain), torch.tensor([1.0], dtype=torch.float64), torch.tensor([0.1, 0.2], dtype=torch.float64)
    for made in (s.init(q, 1.1 * q, h=h), s.init_qv(q, q, h=h)):
        assert [tuple(x.shape) for x in made] == [(2, 1), (2, 1), (2,)]
        assert s.velocity(State(q, q, q[0]), h).shape == (2, 1)
    assert [x.shape[0] for x in s.step_pair(q, 1.1 * q, q[0], h)] == [2, 2, 2]
    assert s.step(State(q, q, q[0]), 0.1, guess=q.float()).state.q.dtype == torch.float64
