"""The environments of `hz.VectorEnv`."""

import importlib
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import herglotz as hz
from herglotz.errors import InputError
from herglotz.export import compile_c, export_c, load_c
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Status, Stepper
from tests.compilers import needs_compiler

pytestmark = needs_compiler
H, B = 0.05, 7
BOX = {"q_low": [-1.0], "q_high": [2.0], "p_low": [-3.0], "p_high": [3.0], "s_low": [-1e-3], "s_high": [1e-3]}


def pendulum(angle=True, **options):
    """θ″ = −sin θ − 0.1 θ′ + u, or x″ = −x − 0.1 x′ + u."""
    one = (1.0,)
    options = {"level": "forced", "inputs": 1, "input_map": (1.0,), **options}
    return ContactLagrangian(ModelConfig((angle,), **options, scale=one, speed=one, stiffness=one, tilt=(0.0,),
                                         rate=0.1, potential_width=0))  # fmt: skip


@pytest.fixture(scope="module")
def stepper():
    return compile_c(pendulum(), h=H, box=BOX)


def reward(q, v, u):
    return -(q[:, 0] ** 2) - 0.1 * v[:, 0] ** 2 - 0.01 * u[:, 0] ** 2


def near_rest(generator, count):
    return generator.uniform(-0.5, 0.5, (count, 1)), generator.uniform(-0.5, 0.5, (count, 1))


def fixed(q, v, s=0.0):
    """Starts at one state."""
    return lambda _, count: (np.full((count, 1), q), np.full((count, 1), v), np.full(count, s))


def made(source, **options) -> Any:
    options = {"reward": reward, "reset": near_rest, "input_low": [-1.0], "input_high": [1.0], **options}
    return hz.VectorEnv(source, options.pop("num_envs", B), **options)


def actions(k, count=B):
    return np.random.default_rng(k).uniform(-1.2, 1.2, (count, 1))


def test_a_step_is_the_step_of_the_model(stepper):
    # fails if an input acts on another environment, a step too late or unsaturated, or p is shown in place of v
    env = made(stepper, steps_per_action=3)
    seen, infos = env.reset(seed=3)
    assert infos == {}
    eager, x = Stepper(pendulum()), torch.from_numpy(seen)
    state = eager.init_qv(x[:, :1], x[:, 1:], h=H)
    for k in range(5):
        observed, rewards, terminated, truncated, infos = env.step(actions(k))
        u = np.clip(actions(k), -1, 1)
        with torch.no_grad():
            for _ in range(3):
                state = eager.step(state, H, u=torch.from_numpy(u)).state
            v = eager.velocity(state, H).numpy()
        np.testing.assert_allclose(observed, np.concatenate([state.q.numpy(), v], 1), rtol=0, atol=1e-12)
        np.testing.assert_allclose(rewards, reward(state.q.numpy(), v, u), rtol=0, atol=1e-12)
        assert not terminated.any() | truncated.any()
        assert infos == {}


def test_a_header_with_numbers_of_run_time_steps_with_their_defaults(stepper):
    # fails if the loop in C gives a step or a velocity no numbers
    asked = compile_c(pendulum(), h=H, box=BOX, parameters=["damping.rate"])
    seen = []
    for each in (stepper, asked):
        env = made(each)
        env.reset(seed=4)
        seen.append(env.step(np.full((env.num_envs, 1), 0.3))[0])
    np.testing.assert_allclose(seen[1], seen[0], rtol=1e-12)


def test_the_same_seed_gives_the_same_motion(stepper):  # fails if starts are not drawn by the generator of the seed
    def motion(env, seed):
        rows = [env.reset(seed=seed)[0]]
        return np.stack(rows + [env.step(actions(k))[0] for k in range(12)])

    env = made(stepper, max_episode_steps=4)
    first = motion(env, 5)
    np.testing.assert_array_equal(motion(env, 5), first)
    np.testing.assert_array_equal(motion(made(stepper, max_episode_steps=4), 5), first)
    assert not np.array_equal(motion(env, 6), first)


def test_the_next_step_resets(stepper):
    # fails if an episode is cut a step early or late, its reset counts as a step, or gives a reward or a move
    env = made(stepper, max_episode_steps=3, reset=fixed(0.25, 0.0))
    env.reset(seed=0)
    for k in range(8):
        observed, rewards, terminated, truncated, _ = env.step(np.ones((B, 1)))
        assert truncated.tolist() == [k % 4 == 2] * B
        assert not terminated.any()
        fresh = k % 4 == 3
        assert (observed == [0.25, 0.0]).all() == fresh
        assert (rewards == 0).all() == fresh


def test_the_same_step_resets(stepper):
    # fails if the last observation of an episode is lost, or belongs to the next episode
    env, other = (made(stepper, max_episode_steps=2, autoreset_mode=mode) for mode in ("SameStep", "NextStep"))
    for one in (env, other):
        one.reset(seed=1)
        one.step(actions(0))
    observed, rewards, _, truncated, infos = env.step(actions(1))
    last, rewards_there, *_ = other.step(actions(1))
    np.testing.assert_array_equal(np.stack([*infos["final_obs"]]), last)
    np.testing.assert_array_equal(rewards, rewards_there)
    assert truncated.all()
    assert infos["_final_obs"].all()
    assert infos["_final_info"].all()
    np.testing.assert_array_equal(other.step(actions(2))[0], observed)  # drawn by the same generator
    *_, truncated, infos = env.step(actions(2))
    assert not truncated.any()
    assert infos == {}


def test_a_user_resets(stepper):  # fails if an ended environment steps on, or others are reset with it
    ends = lambda q, *_: q[:, 0] > 0.3  # noqa: E731
    starts = np.array([[0.29], [0.0]])
    draw = lambda _, count: (starts[:count], np.full((count, 1), 0.9))  # noqa: E731
    env = made(stepper, num_envs=2, autoreset_mode="Disabled", reset=draw, terminated=ends)
    with pytest.raises(InputError, match="call reset before the first step"):
        env.step(np.zeros((2, 1)))
    with pytest.raises(InputError, match="the first reset must be of all environments"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset()
    before, _, terminated, *_, infos = env.step(np.zeros((2, 1)))
    assert terminated.tolist() == [True, False]
    assert infos == {}  # the task ended it, not the model
    with pytest.raises(InputError, match=r"environment 0 has ended; reset those that have: env.reset\(options"):
        env.step(np.zeros((2, 1)))
    after, _ = env.reset(options={"reset_mask": terminated})
    np.testing.assert_allclose(after[0], [0.29, 0.9], rtol=1e-12)
    np.testing.assert_array_equal(after[1], before[1])
    env.step(np.zeros((2, 1)))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_outside_the_box_an_environment_ends(stepper, mode):
    # fails if a model is stepped where it was fitted to nothing, its last position leaves the space, the s of a motion
    # that does not depend on it counts, or the exit is not paid
    env = made(stepper, reset=fixed(1.95, 1.5), exit_reward=-100.0, autoreset_mode=mode)
    env.reset()
    observed, rewards, terminated, truncated, infos = env.step(np.zeros((B, 1)))
    assert terminated.all()
    assert not truncated.any()
    if mode == "SameStep":
        np.testing.assert_allclose(observed, [[1.95, 1.5]] * B, rtol=1e-12)
        observed, infos = np.stack([*infos["final_obs"]]), infos["final_info"]
    assert (observed[:, 0] == 2.0).all()
    assert (infos["status"] == 16).all()
    assert infos["_status"].all()
    assert env.observation_space.contains(observed)
    np.testing.assert_allclose(rewards, -100 - 4 - 0.1 * observed[:, 1] ** 2, rtol=1e-12)


def test_a_failed_step_ends_one_environment():
    # fails if a NaN is observed, a neighbour in the same register ends too, or the state before the failure is lost
    fast = np.zeros((B, 1))
    fast[2] = 1e300  # the action of a step is beyond the largest number
    starts = lambda _, count: (np.full((count, 1), 0.5), fast[:count])  # noqa: E731
    env = made(compile_c(pendulum(), h=H), reset=starts, reward=lambda q, *_: q[:, 0])
    first, _ = env.reset()
    observed, _, terminated, _, infos = env.step(np.zeros((B, 1)))
    assert terminated.tolist() == infos["_status"].tolist() == [i == 2 for i in range(B)]
    assert infos["status"].tolist() == [int(Status.DIVERGED) * (i == 2) for i in range(B)]
    assert np.isfinite(observed).all()
    np.testing.assert_array_equal(observed[2], first[2])
    assert (observed[[0, 1, 3]] != first[[0, 1, 3]]).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("model", ["float32", "float64"])
def test_observations_are_of_their_space(dtype, model):
    # fails if rounding puts an observation beyond the bounds, or a type is not the one asked for
    box = BOX | {"q_low": [-0.1], "q_high": [0.1]}
    env = made(compile_c(pendulum(), h=H, box=box, dtype=model), dtype=dtype, reset=fixed(0.1 - 1e-6, 0.0))
    observed, _ = env.reset(seed=0)
    for k in range(8):
        assert observed.dtype == env.single_observation_space.dtype == np.dtype(dtype)
        assert env.observation_space.contains(observed)
        observed, rewards, *_ = env.step(np.float32(actions(k)))
        assert rewards.dtype == np.float64


def test_angles_lie_within_half_a_turn_of_the_middle_of_their_box(stepper):
    # fails if a turned angle is outside the box, or is observed in another turn than that of the box
    env = made(stepper, reset=fixed(0.5 + 2 * np.pi, 0.1))
    observed, _ = env.reset()
    np.testing.assert_allclose(observed, [[0.5, 0.1]] * B, atol=1e-12)
    free = made(compile_c(pendulum(), h=H), reset=fixed(3.0, 3.0))
    free.reset()
    seen = np.array([free.step(np.zeros((B, 1)))[0][0, 0] for _ in range(3)])
    assert free.single_observation_space.high[0] == np.pi
    assert ((seen > -np.pi) & (seen < -2.5)).all()


def test_a_position_is_not_turned():  # fails if a position on a line is taken modulo a turn
    env = made(compile_c(pendulum(False), h=H), reset=fixed(50.0, 0.0))
    assert (env.reset()[0][:, 0] == 50.0).all()


def test_a_header_and_a_run_give_the_range_of_inputs(tmp_path):
    # fails if the range of recorded inputs is not written, not read, or taken from the part that was not fitted
    from dataclasses import replace

    from herglotz.export import export_run
    from herglotz.training import FitConfig, Run

    model, n = pendulum(), 30
    u = torch.linspace(-1, 2, n, dtype=torch.float64)[:, None]
    with torch.no_grad():
        still = torch.zeros(1, dtype=torch.float64)
        motion = Stepper(model).rollout(still, still, still[0], h=H, steps=n - 1, inputs=u[:-1])
    data = replace(hz.Trajectories.of(H * np.arange(n), motion.q, u=u, angles=(True,), source="X", hold="zero"),
                   columns=(("F", "input", "N"),))  # fmt: skip
    states = State(motion.q, motion.p, motion.s)
    run = Run(model, FitConfig(), {}, data, (20,), states, H, BOX, [])
    path = export_run(run, tmp_path / "arm.h")
    given: Any = {"input_low": None, "input_high": None}
    for source in (path, str(path), load_c(path), run):
        env = made(source, **given)
        assert (env.single_action_space.low, env.single_action_space.high) == (-1.0, float(u[19]))
    late = load_c(path)
    late.metadata["arrival"] = {"hold": "zero", "delay": 0.01, "lag": None}
    with pytest.warns(UserWarning, match=r"recorded inputs act with a delay of 0.01 s; an action acts at once"):
        made(late)
    derived = load_c(path)
    derived.metadata["columns"] = [["F", "input", "N"], ["F^2", "input term", "N^2"]]
    with pytest.raises(InputError, match=r"the inputs F\^2 follow from others"):
        made(derived)


ERRORS = [
    ({"num_envs": 0}, "num_envs must be a whole number >= 1, got 0"),
    ({"max_episode_steps": 1.5}, "max_episode_steps must be a whole number >= 1, got 1.5"),
    ({"steps_per_action": True}, "steps_per_action must be a whole number >= 1, got True"),
    ({"autoreset_mode": "next"}, "autoreset_mode must be one of NextStep, SameStep, Disabled, got 'next'"),
    ({"dtype": "float16"}, "dtype must be 'float32' or 'float64', got 'float16'"),
    ({"exit_reward": np.nan}, "exit_reward must be a finite number, got nan"),
    ({"input_low": [0.0, 1.0]}, r"input_low must hold 1 finite number\(s\), one an input, got \[0.0, 1.0\]"),
    ({"input_high": ["a"]}, r"input_high must hold 1 finite number\(s\)"),
    ({"input_low": None}, "the range of the inputs is not recorded; give input_low"),
    ({"input_low": [1.0]}, r"input_low must be below input_high, got \[1.0\] and \[1.0\]"),
    ({"h": -1.0}, "h must be > 0, got -1"),
]


@pytest.mark.parametrize(("options", "message"), ERRORS, ids=lambda x: next(iter(x)) if isinstance(x, dict) else "")
def test_a_wrong_setting_is_named(stepper, options, message):  # fails if a setting that means nothing is taken
    with pytest.raises(InputError, match=message):
        made(stepper, **options)


def test_what_is_no_environment_is_refused(tmp_path):
    # fails if a model without actions, or another format, ends in a message of numpy or ctypes
    with pytest.raises(InputError, match="VectorEnv takes a run, the path of a C header or a stepper of one"):
        made(pendulum())
    with pytest.raises(InputError, match="the model takes no inputs, so there is no action"):
        made(compile_c(pendulum(level="linear", inputs=0, input_map=()), h=H))
    plain = compile_c(pendulum(), h=H)
    del plain.programs["velocity"]
    with pytest.raises(InputError, match="holds no velocities; export it again"):
        made(plain)
    export_c(pendulum(), tmp_path / "arm.h", h=H, h_range=(H, H))
    with pytest.raises(InputError, match=r"h must lie in \[0.05, 0.05\]"):
        made(tmp_path / "arm.h", h=2 * H)


WRONG = [
    (lambda _, k: (np.zeros((k, 1)),), r"reset must return \(q, v\) or \(q, v, s\), got 1 entries"),
    (lambda _, k: (np.zeros(k), np.zeros((k, 1))), r"reset: q must have the shape \(7, 1\), got \(7,\)"),
    (lambda _, k: (np.zeros((k, 1)), np.full((k, 1), np.inf)), "reset: v of row 0 is NaN or inf; draw finite numbers"),
    (fixed(2.5, 0.0), r"reset: row 0, q = \[2.5\], v = \[0.0\], is outside the box of the fitted data"),
]


@pytest.mark.parametrize(("reset", "message"), WRONG)
def test_a_wrong_start_is_named(stepper, reset, message):  # fails if an episode begins at no state
    with pytest.raises(InputError, match=message):
        made(stepper, reset=reset).reset()


def test_wrong_answers_and_actions_are_named(stepper):
    # fails if a NaN reaches an agent, or an array of another shape is spread over environments
    cases: list[tuple[dict[str, Any], str]] = [
        ({"reward": lambda q, *_: q}, r"reward must return \(7,\) numbers, got float64 of shape \(7, 1\)"),
        ({"reward": lambda q, *_: np.where(q[:, 0] == q[4, 0], np.nan, 0.0)}, "reward: nan for environment 4 at q ="),
        ({"terminated": lambda q, *_: q[:, 0]}, r"terminated must return \(7,\) booleans, got float64"),
    ]
    for options, message in cases:
        env = made(stepper, **options)
        env.reset(seed=0)
        with pytest.raises(InputError, match=message):
            env.step(np.zeros((B, 1)))
    env = made(stepper)
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"actions must be numbers of shape \(7, 1\), got float64 of shape \(7,\)"):
        env.step(np.zeros(B))
    with pytest.raises(InputError, match="actions: NaN for environment 5; give finite numbers"):
        env.step(np.where(np.arange(B)[:, None] == 5, np.nan, 0.0))
    for mask in (np.ones(3, bool), np.zeros(B, bool), [True] * B, np.ones(B)):
        with pytest.raises(InputError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})
    with pytest.raises(InputError, match="options may hold reset_mask alone, got speed"):
        env.reset(options={"speed": 1})


def test_arrays_are_not_shared(stepper):
    # fails if an array that was given out changes with the next step, or a reward can change the motion
    kept = []
    env = made(stepper, reward=lambda q, v, u: kept.append((q, v, u)) or q[:, 0])
    first, _ = env.reset(seed=0)
    copies = [first.copy()]
    second = env.step(actions(0))[0]
    copies.append(second.copy())
    before = [x.copy() for x in kept[0]]
    env.step(actions(1))
    for one, other in zip((first, second, *kept[0]), (*copies, *before), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not any(x.flags.writeable for x in kept[0])


def test_a_missing_package_is_named(monkeypatch):  # fails if a newcomer sees a ModuleNotFoundError without a remedy
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "herglotz.environment", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'herglotz\[gymnasium\]'"):
        importlib.import_module("herglotz.environment")


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_it_is_an_environment_of_gymnasium(stepper, mode):
    # fails if wrappers of gymnasium do not work with it: spaces, metadata, infos, the count of steps of an episode
    env = made(stepper, autoreset_mode=mode, max_episode_steps=5, dtype="float32")
    assert isinstance(env, gymnasium.vector.VectorEnv)
    assert env.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode(mode)
    wrapped = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    observed, _ = wrapped.reset(seed=0)
    wrapped.action_space.seed(0)
    returns = np.zeros(B)
    for k in range(5):
        assert wrapped.observation_space.contains(observed)
        action = wrapped.action_space.sample()
        assert wrapped.action_space.contains(action)
        observed, rewards, _, truncated, infos = wrapped.step(action)
        returns += rewards
        assert truncated.all() == (k == 4)
    assert (infos["episode"]["l"] == 5).all()
    np.testing.assert_allclose(infos["episode"]["r"], returns)
    wrapped.close()
