# %% [markdown]
# # Swing a pendulum up with a learned model
#
# A motor pushes a cart, from which a pendulum hangs. Its motion is recorded, learned and exported to CasADi; IPOPT then
# finds forces on the learned step that bring the pendulum upright, again and again while it moves (model predictive
# control). The controller never sees the equations of the plant. CasADi comes with the extra `control`:
# `pip install 'herglotz[control]'`; a C compiler is needed, too.
#
# The plant: cart 1 kg, pendulum 0.3 kg at 0.5 m, viscous friction of both. θ = 0 hangs, θ = π stands.

# %%
import numpy as np

CART, MASS, LENGTH, GRAVITY = 1.0, 0.3, 0.5, 9.81


def rate(z, force):
    """Velocities and accelerations at z = (x, θ, x′, θ′)."""
    _, angle, v, w = z
    coupling = MASS * LENGTH * np.cos(angle)
    inertia = np.array([[CART + MASS, coupling], [coupling, MASS * LENGTH**2]])
    push = force - 0.4 * v + MASS * LENGTH * w**2 * np.sin(angle)
    turn = -MASS * GRAVITY * LENGTH * np.sin(angle) - 0.01 * w
    return np.concatenate([[v, w], np.linalg.solve(inertia, [push, turn])])


def plant(z, force, h, parts=20):
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
# Four recordings of 8 s: three sine waves of force, and a spring that keeps the cart on its track. Positions have 1 mm
# and 1 mrad of noise; velocities are not recorded.

# %%
draw = np.random.default_rng(0)
recordings = []
for angle in (0.5, 2.0, 2.8, -1.5):
    z, rows = np.array([0.0, angle, 0.0, 0.0]), []
    frequency, phase = draw.uniform(0.5, 2.0, 3), draw.uniform(0, 6, 3)
    for t in 0.05 * np.arange(161):
        force = 4 * np.sin(2 * np.pi * frequency * t + phase).sum() - 8 * z[0] - 2 * z[2]
        rows.append([t, *(z[:2] + 1e-3 * draw.normal(size=2)), force])
        z = plant(z, force, 0.05)
    recordings.append(dict(zip(("t[s]", "x[m]", "theta[rad]", "force[N]"), np.transpose(rows), strict=True)))

# %% [markdown]
# ## Learn
#
# Nothing is told: that the inertia depends on cos θ is found.

# %%
import herglotz as hz

run = hz.fit(recordings)
print(run.summary())

# %% [markdown]
# ## Export
#
# One C file with the step (q, p, s), u, h ↦ (q, p, s)′ and its Jacobian, as CasADi calls external functions. The
# controller holds the force for 0.05 s, which is a few steps of the model, and looks 40 such intervals ahead: compiled
# with this horizon, `cart_shoot` is all of them in one call, each from its own state, with one sparse Jacobian.

# %%
import subprocess

import casadi as ca

COUNT = 40
run.export("cart.c")
flags = ["-O3", "-march=native", "-fPIC", "-shared", f"-Dcart_HORIZON={COUNT}"]
subprocess.run(["cc", *flags, "cart.c", "-o", "cart.so", "-lm"], check=True)
shoot = ca.external("cart_shoot", "./cart.so")
print(shoot)
print(f"{round(0.05 / run.h)} steps of the model in each interval")

# %% [markdown]
# ## The problem of optimal control
#
# Over the next 2 s: states X and forces U that the learned step connects, at most 12 N, ±0.9 m of track, and the least
# squares of the distance from upright. The Hessian is that of the cost (Gauss–Newton): the step has first derivatives.

# %%
UPRIGHT = np.array([0.0, np.pi, 0.0, 0.0, 0.0])
WEIGHT = np.array([1.0, 2.0, 0.05, 0.5, 0.0])  # x, θ, their momenta; s does not matter

X, U, start = ca.MX.sym("X", 5, COUNT + 1), ca.MX.sym("U", 1, COUNT), ca.MX.sym("start", 5)
distance = ca.DM(WEIGHT).T @ (X - UPRIGHT) ** 2
cost = ca.sum2(distance) + 20 * distance[-1] + 0.003 * ca.sumsqr(U)
unknowns = ca.veccat(X, U)
gaps = ca.veccat(X[:, 0] - start, shoot(X[:, :-1], U, 0.05) - X[:, 1:])
scale, multipliers = ca.MX.sym("scale"), ca.MX.sym("multipliers", gaps.shape[0])
hessian = ca.triu(scale * ca.hessian(cost, unknowns)[0])
solver = ca.nlpsol(
    "solver",
    "ipopt",
    {"x": unknowns, "f": cost, "g": gaps, "p": start},
    {
        "hess_lag": ca.Function("hess_lag", [unknowns, start, scale, multipliers], [hessian]),
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-4},
        "print_time": False,
    },
)
bound = np.full((5, COUNT + 1), np.inf)
bound[0] = 0.9
bound = np.concatenate([bound.ravel("F"), 12 * np.ones(COUNT)])

# %% [markdown]
# ## The loop
#
# Each 0.05 s the problem is solved from where the plant is, and the first force acts. The plant is measured by
# positions alone, one step of the model apart: `init` makes (q, p, s) of two positions.

# %%
from time import perf_counter

import torch

model = hz.compile(run)
z, state = np.zeros(4), np.zeros(5)
X_next, U_next = np.linspace(state, UPRIGHT, COUNT + 1).T, 0.1 * np.ones(COUNT)
path, forces, plans, seconds = [z], [], [], []
for _ in range(80):
    began = perf_counter()
    guess = np.concatenate([X_next.ravel("F"), U_next])
    found = np.array(solver(x0=guess, p=state, lbx=-bound, ubx=bound, lbg=0, ubg=0)["x"]).ravel()
    seconds.append(perf_counter() - began)
    assert solver.stats()["success"], solver.stats()["return_status"]
    planned, U_now = found[: 5 * (COUNT + 1)].reshape(5, -1, order="F"), found[5 * (COUNT + 1) :]

    before = plant(z, U_now[0], 0.05 - run.h)
    z = plant(before, U_now[0], run.h)
    q0, q1, u0 = (torch.tensor(value).reshape(1, -1) for value in (before[:2], z[:2], U_now[0]))
    at = model.init(q0, q1, torch.zeros(1, dtype=torch.float64), run.h, u=u0)
    state = np.concatenate([z[:2], at.p[0], [0.0]])

    X_next, U_next = np.c_[planned[:, 1:], planned[:, -1]], np.r_[U_now[1:], U_now[-1]]
    path.append(z)
    forces.append(U_now[0])
    plans.append(planned)
path = np.array(path)
upright = abs(path[:, 1] - np.pi) < 0.1
since = 0.05 * (np.flatnonzero(~upright)[-1] + 1)
print(f"upright to 0.1 rad from {since:.2f} s on; at the end {path[-1, 1] - np.pi:.1e} rad off")
print(f"the cart moves within {abs(path[:, 0]).max():.2f} m, the largest force is {np.abs(forces).max():.1f} N")
miss = [abs(plan[:2, 1] - after[:2]).max() for plan, after in zip(plans, path[1:], strict=True)]
print(f"the plant is within {max(miss):.1e} m and rad of what was foreseen 0.05 s before")
print(f"a solution takes {1000 * np.median(seconds):.0f} ms (median), {1000 * max(seconds):.0f} ms at most")

# %%
from herglotz.plots.style import MODEL, MUTED, UNSEEN, new_figure, styled

t = 0.05 * np.arange(len(path))
with styled():
    figure = new_figure(7.5, 5.5, "Swung up on a learned model")
    panels = figure.subplots(3, 1, sharex=True)
    for k in range(0, 40, 4):
        for row, ax in enumerate(panels[:2]):
            ax.plot(t[k] + 0.05 * np.arange(COUNT + 1), plans[k][row], color=MUTED, lw=0.7)
    panels[0].plot(t, path[:, 0], color=MODEL)
    panels[1].plot(t, path[:, 1], color=MODEL)
    panels[1].axhline(np.pi, color=MUTED, lw=0.7, ls="--")
    panels[2].step(t[:-1], forces, where="post", color=UNSEEN)
    for ax, name in zip(panels, ("x [m]", "theta [rad]", "force [N]"), strict=True):
        ax.set_ylabel(name)
    panels[0].set_title("the plant (blue) and what the learned model foresaw (grey)")
    panels[2].set(xlabel="time [s]", xlim=(0, t[-1]))
figure

# %%
from pathlib import Path

from matplotlib.animation import FuncAnimation, PillowWriter

from herglotz.plots.animation import Animation

with styled():
    film = new_figure(5.0, 3.0, "The plant under control")
    ax = film.subplots()
    ax.set(xlim=(-1.3, 1.3), ylim=(-0.7, 0.7), xlabel="x [m]", aspect="equal", yticks=[])
    ax.axhline(0, color=MUTED, lw=0.7)
    (rod,) = ax.plot([], [], "o-", color=MODEL, lw=2, ms=9)
    (cart,) = ax.plot([], [], "s", color=UNSEEN, ms=14)

    def show(k):
        x, angle = path[k, :2]
        rod.set_data([x, x + LENGTH * np.sin(angle)], [0, -LENGTH * np.cos(angle)])
        cart.set_data([x], [0])

    FuncAnimation(film, show, frames=len(path)).save("swing_up.gif", PillowWriter(fps=20), dpi=70)
Animation(Path("swing_up.gif"))
