"""An L_d of one's own: its losses, its fit, and the files that it is written to."""

import math
from typing import Any, cast

import pytest
import torch
from torch import nn

import herglotz as hz
from herglotz.cached import cached
from herglotz.cli import main
from herglotz.export import export_pt2
from herglotz.mechanics import autograd_partials
from herglotz.models import OwnLagrangian
from herglotz.plots import save_figures
from herglotz.stepping import State, Stepper
from herglotz.training import laplace
from herglotz.training.kernel import source_of
from herglotz.training.parameter_vector import ParameterVector

H = 0.1


class Spring(nn.Module):
    """|v|²/2 − k |q|²/2 − γs, with a term in s² that makes s enter the motion."""

    def __init__(self, k=1.0, gamma=0.2, bend=0.0, dtype=torch.float64):
        super().__init__()
        self.k, self.gamma = (nn.Parameter(torch.tensor(x, dtype=dtype)) for x in (k, gamma))
        self.bend = bend

    def forward(self, q0, q1, s0, h):
        v = (q1 - q0) / h[..., None]
        V = self.k * ((q0 * q0).sum(-1) + (q1 * q1).sum(-1)) / 4
        return h * ((v * v).sum(-1) / 2 - V - self.gamma * s0 - self.bend * s0 * s0)


class Pushed(Spring):
    """The same with an input."""

    def at(self, u):
        return lambda q0, q1, s0, h: self(q0, q1, s0, h) + h * (u * q0).sum(-1)


class Linear(Spring):
    """The same with a layer, which has a dtype and a number of coordinates."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(1, 1).double()

    def forward(self, q0, q1, s0, h):
        return super().forward(q0, q1, s0, h) + 0 * self.layer(q0)[..., 0]


class Residual(nn.Module):
    """The residual of a recording by an L_d, for `functional_call`."""

    def __init__(self, L_d):
        super().__init__()
        self.L_d = L_d

    def forward(self, q):
        return hz.losses.herglotz_residual(self.L_d, q, H)


def motion(L_d, steps=40, n=1, inputs=None):
    q = torch.linspace(0.3, 1.0, 3 * n, dtype=torch.float64).reshape(3, n)
    with torch.no_grad():
        return Stepper(L_d).rollout(q, 0.3 * q, h=H, steps=steps, inputs=inputs)


def least(loss, parameter):
    """The derivative of a loss by one number, or by all of a tensor together, by differences."""
    ends = []
    for change in (1e-5, -1e-5):
        with torch.no_grad():
            parameter += change
        ends.append(float(loss().detach()))
        with torch.no_grad():
            parameter -= change
    return (ends[0] - ends[1]) / 2e-5


@pytest.mark.parametrize("bend", [0.0, 0.3])
def test_the_residual_of_a_motion_is_zero_and_of_another_model_is_not(bend):
    # fails if s is not carried along, or R_k is taken with the momentum of another step
    L_d = Spring(bend=bend)
    out = motion(L_d)
    assert hz.losses.herglotz_residual(L_d, out.q, H, s0=out.s[..., 0]).abs().max() < 1e-13
    assert hz.losses.herglotz_residual(Spring(k=1.1, bend=bend), out.q, H).abs().max() > 1e-4


def test_the_residual_is_the_error_of_the_next_position():  # fails if J is not ∂R/∂q1, or has the other sign
    L_d, q = Spring(), motion(Spring()).q.clone()
    q[:, -1] += 1e-3
    assert torch.allclose(hz.losses.herglotz_residual(L_d, q, H)[:, -1], torch.full((3, 1), 1e-3).double(), atol=1e-12)


def test_a_smaller_L_d_has_a_smaller_raw_residual_alone():  # fails if the preconditioner is left out: it collapses
    L_d, q = Spring(k=1.3), motion(Spring()).q
    small = lambda *x: 0.01 * L_d(*x)  # noqa: E731
    small_s = lambda q0, q1, s0, h: small(q0, q1, 100 * s0, h)  # noqa: E731  the same motion: s in another unit
    (r, R), (r_small, R_small) = (
        [hz.losses.herglotz_residual(x, q, H, preconditioned=on) for on in (True, False)] for x in (L_d, small_s)
    )
    assert torch.allclose(r_small, r, rtol=1e-9, atol=0.0)
    assert torch.allclose(R_small, 0.01 * R, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize(
    "null",
    [
        lambda q0, q1, s0, h: 0 * h * (q0 * q1).sum(-1) * s0,  # constant
        lambda q0, q1, s0, h: h * (q0 * q0).sum(-1) - 0.1 * h * s0 + 0 * q1.sum(-1),  # blind to q1
    ],
)
def test_null_models_are_refused(null):  # fails if an L_d that steps nowhere has a small loss, or NaN
    with pytest.raises(hz.InputError, match="must join q0 to q1"):
        hz.losses.herglotz_residual(null, motion(Spring()).q, H)


@pytest.mark.parametrize("bend", [0.0, 0.3])
def test_gradients_of_the_losses_are_those_of_differences(bend):  # fails if J, s or an implicit step is held constant
    L_d, out = Spring(k=1.2, bend=bend), motion(Spring(bend=bend))
    noisy = out.q + 0.01 * torch.randn(out.q.shape, generator=torch.Generator().manual_seed(0)).double()
    starts = hz.losses.starts(noisy, 11)
    losses = [
        (lambda: hz.losses.herglotz_residual(L_d, noisy, H).square().mean(), ()),
        (lambda: hz.losses.shooting(L_d, noisy, H, starts, length=11).misfit.square().sum(), starts),
        # fails if a line search cannot trust the gradient, because the scale of the gaps in s is held constant
        (lambda: hz.losses.shooting(L_d, noisy, H, starts, length=11).loss, starts),
    ]
    for loss, further in losses:
        for x in (*L_d.parameters(), *further):
            x.grad = None
        loss().backward()
        for x in (*L_d.parameters(), *further):
            assert x.grad is not None
            assert float(x.grad.sum()) == pytest.approx(least(loss, x), rel=1e-5, abs=1e-8)


@pytest.mark.parametrize("length", [1, 7, 13, 100])
def test_shooting_misses_nothing_of_a_motion(length):  # fails if segments are laid beside their samples
    L_d, out = Spring(), motion(Spring())
    starts = hz.losses.starts(out.q, length)
    at = torch.arange(starts.s.shape[-1]) * min(length, 39)
    found = hz.losses.shooting(L_d, out.q, H, starts._replace(s=out.s[:, at]), length=length)
    assert found.misfit.shape == out.q.shape
    assert max(float(x.detach().abs().max()) for x in found if x.numel()) < 1e-12
    assert hz.losses.shooting(Spring(k=1.1), out.q, H, starts, length=length).loss > 1e-9


def test_joints_are_the_gaps_between_segments():  # fails if a segment may start anywhere
    L_d, out = Spring(), motion(Spring())
    starts = hz.losses.starts(out.q, 10)
    at = torch.arange(3) * 10
    moved = starts._replace(q0=starts.q0.detach().clone(), s=out.s[:, at])
    moved.q0[:, 1] += 0.01
    joints = hz.losses.shooting(L_d, out.q, H, moved, length=10).joints
    assert torch.allclose(joints[:, 0, 0], torch.full((3,), -0.01).double(), atol=1e-12)


def test_inputs_and_single_precision_and_unequal_steps():  # fails if u or h of another step is taken, or a dtype made
    u = torch.linspace(-1, 1, 40).double()[:, None]
    out = motion(Pushed(), inputs=u)
    assert hz.losses.herglotz_residual(Pushed(), out.q, H, u=u).abs().max() < 1e-13
    assert hz.losses.herglotz_residual(Pushed(), out.q, H, u=u.roll(1, 0)).abs().max() > 1e-5
    h = torch.linspace(0.05, 0.15, 40).double()
    uneven = Stepper(Spring()).rollout(out.q[:, 0], out.p[:, 0], h=h)
    assert hz.losses.herglotz_residual(Spring(), uneven.q, h).abs().max() < 1e-13
    found = hz.losses.shooting(Spring(), uneven.q, h, hz.losses.starts(uneven.q, 11), length=11)
    assert found.misfit.detach().abs().max() < 1e-12
    found = hz.losses.shooting(Pushed(), out.q, H, hz.losses.starts(out.q, 11), u=u, length=11)
    assert found.misfit.detach().abs().max() < 1e-12
    single = hz.losses.herglotz_residual(Spring(dtype=torch.float32), uneven.q.float(), h.float())
    assert single.dtype == torch.float32
    assert single.abs().max() < 1e-5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"q": torch.zeros(5).double()}, r"q needs shape"),
        ({"q": torch.zeros(2, 1).double()}, r"at least 3 samples"),
        ({"q": torch.tensor([[0.0], [math.nan], [1.0]])}, r"not finite at \(1, 0\)"),
        ({"h": -0.1}, "h must be"),
        ({"h": torch.ones(7).double()}, r"h needs shape \(3, 40\)"),
        ({"u": torch.ones(3, 7, 1).double()}, "u needs shape"),
        ({"u": torch.ones(40, 1).double()}, "takes no inputs"),
        ({"s0": 0.0}, "s0 must be a tensor"),
        ({"q": motion(Spring()).q.float(), "L_d": Linear()}, r"Linear does not take .*float32, .*float64: "),
        ({"q": motion(Spring()).q[..., 0], "L_d": Linear()}, r"Linear does not take positions of shape \(2, 41\)"),
    ],
)
def test_wrong_arguments_are_named(change, words):  # fails if a wrong shape spreads in silence
    given: dict[str, Any] = {"L_d": Spring(), "q": motion(Spring()).q, "h": H} | change
    with pytest.raises(hz.InputError, match=words):
        hz.losses.herglotz_residual(**given)


# torch.compile warns of its own modules.
@pytest.mark.filterwarnings("ignore")
def test_a_compiled_module_is_refused():  # fails if torch's words on donated buffers reach the user
    compiled, q = torch.compile(Spring(), backend="aot_eager"), motion(Spring()).q
    start = State(q[0, 0], q[0, 0], q[0, 0, 0])
    for ask in (
        lambda: hz.losses.herglotz_residual(compiled, q, H),
        lambda: hz.losses.shooting(compiled, q, H, hz.losses.starts(q, 10), length=10),
        lambda: Stepper(compiled).step(start, H),
    ):
        with pytest.raises(hz.InputError, match=r"compiled by torch\.compile.*give the module that was compiled"):
            ask()


def test_starts_of_another_length_are_refused():  # fails if segments are cut elsewhere than they start
    q = motion(Spring()).q
    with pytest.raises(hz.InputError, match="make them by starts"):
        hz.losses.shooting(Spring(), q, H, hz.losses.starts(q, 10), length=5)
    with pytest.raises(hz.InputError, match="starts must be those of"):
        hz.losses.shooting(Spring(), q, H, cast(Any, None), length=5)
    with pytest.raises(hz.InputError, match=r"whole number >= 1, got 1\.5"):
        hz.losses.starts(q, cast(Any, 1.5))


def test_function_transforms_go_through_the_residual():  # fails if autograd is asked inside them, or vmap for a number
    q = 1.1 * motion(Spring(bend=0.3)).q
    nets = [Spring(k, bend=0.3) for k in (0.5, 1.5)]
    loss = lambda theta: torch.func.functional_call(Residual(nets[0]), theta, (q,)).square().mean()  # noqa: E731
    each = [{f"L_d.{name}": x.detach() for name, x in net.named_parameters()} for net in nets]
    slopes = torch.func.vmap(torch.func.grad(loss))({name: torch.stack([x[name] for x in each]) for name in each[0]})
    for row, net in enumerate(nets):
        hz.losses.herglotz_residual(net, q, H).square().mean().backward()
        for name, x in net.named_parameters():
            torch.testing.assert_close(slopes[f"L_d.{name}"][row], x.grad, rtol=1e-10, atol=0)
    with pytest.raises(hz.InputError, match="vmap does not go through steps"):
        torch.func.vmap(lambda q: Stepper(nets[0]).rollout(q, q, h=H, steps=2).q)(q[:, 0])


def test_a_short_step_of_float32_is_taken_as_any_other():
    # fails if increments of positions are asked of the package's models alone: a fit in float32 ended in an error
    L_d, q, delta, s = (
        OwnLagrangian(Spring(), 1),
        torch.ones(3, 1).double(),
        torch.full((3, 1), 0.1).double(),
        torch.ones(3),
    )
    parameters = ParameterVector(cast(Any, L_d))
    at, h = parameters.at(parameters.get()), torch.full((3,), H).double()
    short, plain = at.partials_increment(q, delta, s.double(), h, 2), L_d.partials(q, q + delta, s.double(), h, 2)
    for name in ("L", "D1", "D2", "D3", "D12"):
        torch.testing.assert_close(getattr(short, name), getattr(plain, name), rtol=1e-12, atol=1e-14)


def test_what_is_made_once_is_not_of_inference_mode():
    # fails if a step in inference mode leaves an index behind that stops every later training
    made = cached(lambda n: torch.arange(n))
    with torch.inference_mode():
        assert made(3) is made(3)
    assert not made(3).is_inference()


def test_an_l_d_is_stepped_and_trained_in_inference_mode():
    # fails if derivatives are 0 there, in silence, or if tensors that are made there once stop a later training
    L_d, q = Spring(bend=0.3), torch.ones(3, 1).double()
    ways = [
        lambda q: autograd_partials(L_d, 0.9 * q, q, q[..., 0], H, 2).D12,
        lambda q: Stepper(L_d).init(0.9 * q, q, h=H).p,
        lambda q: Stepper(L_d).rollout(q, q, h=H, steps=3).p,
        lambda q: Stepper(L_d).velocity(Stepper(L_d).init_qv(q, q, h=H), H),
    ]
    with torch.inference_mode():
        inside, inner = [way(q) for way in ways], q + 0
        run = hz.fit(hz.simulate(hz.scene("damped_oscillator"), trajectories=1, steps=20, h=H, seed=0))
        # fails if a check, or a kernel that is not on the disk yet, asks autograd there
        assert run.verify(samples=4).passed
        inner_source = source_of(run.model)
    assert inner_source == source_of(run.model)
    assert run.metrics["verdict"].startswith("fits to the noise")
    for way, found in zip(ways, inside, strict=True):
        assert found.tolist() == way(q).tolist() == way(inner).tolist()


def test_functional_derivatives_are_those_of_autograd():  # fails if a block is transposed or takes another row
    L_d, make = Spring(bend=0.3), torch.Generator().manual_seed(0)
    mixed = lambda q0, q1, s0, h: L_d(q0, q1, s0, h) + (q0[..., 0] * q1[..., 1] ** 2) * s0  # noqa: E731
    q0, q1 = torch.randn(2, 5, 2, generator=make).double()
    s, h = torch.rand(2, 5, generator=make).double()
    slow, fast = autograd_partials(mixed, q0, q1, s, h, 2), OwnLagrangian(mixed, 2).partials(q0, q1, s, h, 2)
    for name in ("L", "D1", "D2", "D3", "D11", "D12", "D22", "D13", "D23", "D33"):
        assert torch.allclose(getattr(fast, name), getattr(slow, name), rtol=1e-12, atol=1e-14), name


@pytest.fixture(scope="module")
def fitted():
    net = Spring(k=0.5, gamma=0.0)
    data = hz.simulate(hz.scene("damped_oscillator"), trajectories=2, steps=40, h=H, seed=0)
    return net, hz.fit(data, model=net)


def test_a_module_is_fitted_in_place(fitted):  # fails if a copy is trained, or the parameters are not found
    net, run = fitted
    scene = hz.scene("damped_oscillator")
    rule = hz.Stepper(net)
    assert run.model.L_d is net
    assert float(net.gamma.detach()) == pytest.approx(scene.parameters["gamma"], rel=1e-2)
    assert run.metrics["verdict"].startswith("fits")
    assert run.rollout(10).ok
    assert rule.step(run.states_at_end(), H).state.finite.all()
    assert "own L_d" in run.summary()


def test_a_run_says_what_it_cannot_do_with_a_module(fitted, tmp_path):  # fails if an attribute is missing inside
    _, run = fitted
    refused = (
        (run.equation, "no printed equation of Spring, an L_d of your own.*run.continuous"),
        (lambda: laplace(run), "no posterior"),
        (lambda: run.report(tmp_path / "r"), r"no report.*run\.verify"),
        (lambda: run.save(tmp_path / "run"), r"no folder.*torch\.save\(net\.state_dict\(\), path\).*run\.export"),
        (lambda: run.plot("learned"), "functions.*parts of the module"),
        (lambda: run.plot("plan"), "no plan.*training"),
        (lambda: run.plot("sizes"), "no search.*training"),
        (lambda: hz.fit(run.data, plan=run), "no plan.*model=net"),
    )
    for ask, words in refused:
        with pytest.raises(hz.InputError, match=words):
            ask()
    assert not list(tmp_path.iterdir())


def test_a_run_of_a_module_draws_predicts_and_keeps_its_weights(fitted, tmp_path):  # fails if a remedy is none
    net, run = fitted
    names = [path.stem for path in save_figures(run, tmp_path / "figures")]
    assert names == ["trajectory", "phase_portrait", "training"]
    for name in ("momentum_vs_dS", "hj_residual"):
        assert run.plot(name).axes
    assert run.predict(run.data).rms < 1e-3
    assert repr(run).startswith("Run(own L_d Spring, ")
    torch.save(net.state_dict(), tmp_path / "net.pt")
    again = Spring(k=0.5, gamma=0.0)
    again.load_state_dict(torch.load(tmp_path / "net.pt", weights_only=True))
    motion = hz.Stepper(again).rollout(*run.states_at_end(), h=run.h, steps=5)
    assert (motion.q == run.stepper.rollout(*run.states_at_end(), h=run.h, steps=5).q).all()


@pytest.mark.parametrize(("name", "words"), [("net.pt2", "load_exported"), ("motion.csv", "herglotz fit ")])
def test_a_file_in_place_of_a_run_is_named(name, words, tmp_path, capsys):  # fails if `herglotz fit net.pt` is advised
    (tmp_path / name).touch()
    with pytest.raises(hz.InputError, match=f"is a file, and no run.*{words}"):
        hz.load_run(tmp_path / name)
    assert main(["report", str(tmp_path / name)]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("command", ["fit {} --out run", "plot {}", "verify {}", "report {}", "predict {} {}"])
def test_weights_are_no_recording_and_no_run(command, tmp_path, capsys, monkeypatch):
    # fails if weights are told to be an unreadable recording, or a damaged file that herglotz wrote
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.pt").write_bytes(b"weights")
    assert main(command.format("net.pt", "net.pt").split()) == 2
    assert "net.pt: is a file of torch.save, and no recording, run or exported model; in Python" in _line(capsys)
    (tmp_path / "manifest.json").touch()
    assert main(command.format("net.pt", "net.pt").split()) == 2
    assert "the model of a run goes by the folder of the run" in _line(capsys)


def _line(capsys):
    return " ".join(capsys.readouterr().err.split())


def test_what_cannot_be_fitted_says_so():  # fails if the message names a setting that the user did not give
    data = hz.simulate(hz.scene("damped_oscillator"), trajectories=1, steps=20, h=H, seed=0)

    class Branching(Spring):
        def forward(self, q0, q1, s0, h):
            L = super().forward(q0, q1, s0, h)
            return L if bool((L > 0).all()) else 2 * L

    class Normed(Spring):
        def __init__(self):
            super().__init__()
            self.norm = nn.BatchNorm1d(1)

        def forward(self, q0, q1, s0, h):
            return super().forward(q0, q1, s0, h) + self.norm(q0.reshape(-1, 1)).sum()

    class Copied(Spring):
        def forward(self, q0, q1, s0, h):
            return super().forward(torch.as_tensor(q0.detach().numpy()), q1, s0, h)

    class Mixing(Spring):
        def forward(self, q0, q1, s0, h):
            return super().forward(q0 / h * h, q1, s0, h)  # h stands beside q without [..., None]

    class Random(Spring):
        def forward(self, q0, q1, s0, h):
            return super().forward(q0, q1, s0, h) * (1 + torch.rand_like(s0))

    class Infinite(Spring):
        def forward(self, q0, q1, s0, h):
            return super().forward(q0, q1, s0, h) + (q0[..., 0] - q0[..., 0].detach() - 1e-9).sqrt()

    class Grouped(Spring):
        def __init__(self):
            super().__init__()
            self.norm = nn.BatchNorm1d(1).double().eval()

        def forward(self, q0, q1, s0, h):
            return super().forward(q0, q1, s0, h) + 0 * self.norm(q0).sum(-1)

    frozen = Spring()
    frozen.k.requires_grad_(False)
    wrong: tuple[tuple[Any, dict[str, Any], str], ...] = (
        (3, {}, "must be a module or function"),
        (Spring, {}, r"got the class Spring; make one: Spring\(\)"),
        (lambda *x: x[0].sum(-1), {}, "no parameters to train"),
        (frozen, {}, r"L_d.k do not require gradients"),
        (Branching(), {}, "cannot differentiate it sample by sample"),
        (Random(), {}, r"Random is random: .* by \.eval\(\)"),
        (Infinite(), {}, r"Infinite is nan from q = \[.*finite for the recorded positions"),
        (Grouped(), {}, "Grouped takes one leading dimension alone"),
        (Normed(), {}, "Normed: torch.func cannot differentiate it .*batch norms"),
        (Mixing(), {}, r"Mixing: L_d of several samples is not that of each.*h\[..., None\] beside q"),
        (Copied(), {}, "Copied: torch.func cannot differentiate it .* numpy"),
        (Spring(), {"level": "affine"}, "level: model= says"),
        (Spring(), {"objective": "raw"}, "not raw"),
        (Spring(), {"out": "run"}, "without plan, out"),
    )
    for model, settings, words in wrong:
        with pytest.raises(hz.InputError, match=words):
            hz.fit(data, model=model, **settings)


def test_a_module_without_a_model_around_it_is_refused(tmp_path):  # fails if export breaks in an attribute
    bare: Any = Spring()
    with pytest.raises(hz.InputError, match="OwnLagrangian"):
        export_pt2(bare, tmp_path / "x.pt2", h=H)
