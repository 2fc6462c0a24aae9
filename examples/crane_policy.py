# %% [markdown]
# # Train a policy on a learned motion
#
# A motor drives a trolley from which a load hangs. Its motion is recorded and learned, and the learned step becomes
# 4096 environments of gymnasium, which one thread steps at once. A policy that brings the trolley to its place and the
# load to rest is trained there in seconds, by the cross-entropy method, and then moves the real crane, on which it was
# not trained.
# gymnasium comes with the extra `gymnasium`: `pip install 'herglotz[gymnasium]'`; a C compiler is needed, too.
#
# The crane: trolley 1 kg, load 0.3 kg on 0.5 m, viscous friction of both; positions x of the trolley and θ of the load.

# %%
import numpy as np

TROLLEY, LOAD, LENGTH, GRAVITY = 1.0, 0.3, 0.5, 9.81


def rate(z, force):
    """Velocities and accelerations at z = (x, θ, x′, θ′)."""
    _, angle, v, w = z
    coupling = LOAD * LENGTH * np.cos(angle)
    inertia = np.array([[TROLLEY + LOAD, coupling], [coupling, LOAD * LENGTH**2]])
    push = force - 0.4 * v + LOAD * LENGTH * w**2 * np.sin(angle)
    turn = -LOAD * GRAVITY * LENGTH * np.sin(angle) - 0.01 * w
    return np.concatenate([[v, w], np.linalg.solve(inertia, [push, turn])])


def crane(z, force, h, parts=10):
    """The state after a time h under a constant force: the Runge–Kutta method of order 4."""
    d = h / parts
    for _ in range(parts):
        a = rate(z, force)
        b = rate(z + d / 2 * a, force)
        c = rate(z + d / 2 * b, force)
        e = rate(z + d * c, force)
        z = z + d / 6 * (a + 2 * b + 2 * c + e)
    return z


# %% [markdown]
# Four recordings of 8 s: sine waves of force, and a spring that keeps the trolley on its track. Positions have 1 mm and
# 1 mrad of noise; velocities are not recorded.

# %%
draw = np.random.default_rng(0)
recordings = []
for angle in (0.3, -0.6, 0.9, -1.2):
    z, rows = np.array([0.0, angle, 0.0, 0.0]), []
    frequency, phase = draw.uniform(0.5, 2.0, 3), draw.uniform(0, 6, 3)
    for t in 0.05 * np.arange(161):
        force = 4 * np.sin(2 * np.pi * frequency * t + phase).sum() - 8 * z[0] - 2 * z[2]
        rows.append([t, *(z[:2] + 1e-3 * draw.normal(size=2)), force])
        z = crane(z, force, 0.05)
    recordings.append(dict(zip(("t[s]", "x[m]", "theta[rad]", "force[N]"), np.transpose(rows), strict=True)))

# %%
import herglotz as hz

run = hz.fit(recordings)
print(run.summary())

# %% [markdown]
# ## The environments
#
# The reward and the starts are functions of arrays, one row an environment: q and v are (B, 2), u is (B, 1). An action
# is a force that is held for 0.05 s, and saturates at the largest recorded one. An episode has 100 actions, and ends
# where a state leaves the range of the recordings: the model is not asked for what it has not seen, and `exit_reward`
# makes leaving expensive.

# %%
POLICIES, STARTS, ACTIONS = 256, 16, 100


def reward(q, v, u):
    """The negative cost of being away from x = 0, of swinging and of force."""
    return -(q[:, 0] ** 2) - q[:, 1] ** 2 - 0.01 * (v**2).sum(1) - 0.001 * u[:, 0] ** 2


def reset(generator, count):
    """Trolley and load at rest, up to 0.25 m away; the same starts for all policies."""
    places = np.resize(generator.uniform(-0.25, 0.25, STARTS), count)
    return np.stack([places, np.zeros(count)], 1), np.zeros((count, 2))


env = hz.VectorEnv(
    run,
    POLICIES * STARTS,
    reward=reward,
    reset=reset,
    exit_reward=-100.0,
    steps_per_action=round(0.05 / run.h),
    max_episode_steps=ACTIONS,
)
print(env.single_observation_space)
print(env.single_action_space)

# %% [markdown]
# ## The cross-entropy method
#
# A policy is four numbers K, u = K (x, θ, x′, θ′). In each round, 256 of them are drawn from a normal distribution,
# each acts from 16 starts, and the distribution moves to the best 25.


# %%
def returns(gains):
    """The mean return of each policy, (POLICIES,), and how many of its episodes left the recorded range."""
    observed, _ = env.reset(seed=1)
    total, alive = np.zeros(env.num_envs), np.ones(env.num_envs, bool)
    for _ in range(ACTIONS):
        action = (observed.reshape(POLICIES, STARTS, 4) @ gains[:, :, None]).reshape(-1, 1)
        observed, gained, terminated, _, _ = env.step(action)
        total += np.where(alive, gained, 0.0)
        alive &= ~terminated
    return total.reshape(POLICIES, STARTS).mean(1), (~alive).reshape(POLICIES, STARTS).sum(1)


mean, spread = np.zeros(4), np.full(4, 10.0)
for k in range(15):
    gains = mean + spread * draw.normal(size=(POLICIES, 4))
    found, left = returns(gains)
    best = np.argsort(found)[-25:]
    mean, spread = gains[best].mean(0), gains[best].std(0)
    if k % 2 == 0:
        print(f"round {k:2d}: best 25 {found[best].mean():8.3f}, episodes that left the range {left.sum()} of 4096")
print("K =", mean.round(2))

# %% [markdown]
# ## The crane itself
#
# The policy moves the crane from 0.25 m. Beside it, the same gains of the trolley act alone, without those of the load.

# %%
import matplotlib.pyplot as plt

low, high = env.single_action_space.low, env.single_action_space.high
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 4.5))
figure.suptitle("The crane under the policy")
for gain, label in ((mean, "policy"), (mean * [1, 0, 1, 0], "trolley alone")):
    path = [np.array([0.25, 0.0, 0.0, 0.0])]
    for _ in range(ACTIONS):
        path.append(crane(path[-1], np.clip(gain @ path[-1], low, high)[0], 0.05))
    x, theta, *_ = np.transpose(path)
    for axis, values in zip(axes, (x, theta), strict=True):
        axis.plot(0.05 * np.arange(len(x)), values, label=label)
    print(f"{label}: cost {sum(x**2 + theta**2):.3f}, load after 2 s within {np.abs(theta[40:]).max():.4f} rad")
axes[0].set(ylabel="x / m")
axes[1].set(ylabel="θ / rad", xlabel="t / s")
axes[0].legend()
figure
