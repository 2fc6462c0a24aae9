# %% [markdown]
# # A servo log from the drive
#
# Drives write what they like: semicolons, decimal commas, milliseconds, degrees, torque in percent of the rated one,
# and columns that a model of the machine does not need. Here an arm with gravity and dry friction follows a set point;
# the controller's torque is what moves it, and the encoder counts hundredths of a degree.

# %%
from pathlib import Path

import numpy as np

inertia, gravity, viscous, dry, rated = 0.05, 1.2, 0.06, 0.15, 5.0  # kg·m², N·m, N·m·s/rad, N·m, N·m
h, parts, rng = 0.01, 50, np.random.default_rng(2)
moves = np.cumsum(np.r_[0.0, rng.normal(size=9)])  # the next goal every 0.6 s, and a ramp to it
t = h * np.arange(500)
goal = np.interp(t, 0.6 * np.arange(10), 0.8 * np.tanh(moves))
theta, omega, rows = 0.0, 0.0, []
for time, target in zip(t, goal, strict=True):
    torque = np.clip(25 * (target - theta) - 1.2 * omega, -rated, rated)  # held until the next cycle
    percent = round(100 * torque / rated, 2)
    rows.append((1000 * time, np.degrees(target), round(np.degrees(theta), 2), omega * 60 / (2 * np.pi), percent, 41.5))
    for _ in range(parts):
        friction = viscous * omega + dry * np.tanh(omega / 0.001)
        omega += h / parts * (rated * percent / 100 - friction - gravity * np.sin(theta)) / inertia
        theta += h / parts * omega
header = "Time [ms];TargetPosition [deg];ActPosition [deg];ActVelocity [rpm];ActTorque [%];DriveTemp [C]"
lines = [";".join(f"{x:.4f}" for x in row).replace(".", ",") for row in rows]
Path("log.csv").write_text("\n".join([header, *lines]))
print(header, *lines[:2], sep="\n")

# %% [markdown]
# What is each column taken for? The unit says more than the name: `%` is no position, `rpm` is a velocity, and a set
# point is an input.

# %%
import herglotz as hz

data = hz.load("log.csv", show=False)
for name, role, unit in data.columns:
    print(f"{name:12} {role:12} {unit}")

# %% [markdown]
# Two inputs are one too many, as a warning says: the set point moves the controller, not the arm. The torque alone
# acts, and the set point is dropped. Positions in degrees are rad from here on, and reported in both.

# %%
run = hz.fit("log.csv", inputs="ActTorque", drop=["TargetPosition"])
print(run.summary())

# %% [markdown]
# The truth in the same units: 1 for a percent of torque, −24 sin θ, −1.2 θ′, and −3 for dry friction.

# %%
run.plot("learned")

# %% [markdown]
# A log of a controller holds little about the arm by itself: torque follows from position. Whether the numbers are the
# arm's shows where the torque is another one. The arm, let go from 60° with the drive off; the model takes several
# steps between two samples of the log, each `run.h` long:

# %%
steps = round(2 / run.h)
fall = run.rollout(steps, q0=[np.pi / 3], p0=[0.0], inputs=np.zeros(steps))
swing, speed, path = np.pi / 3, 0.0, []
for _ in range(201):
    path.append(swing)
    for _ in range(parts):
        friction = viscous * speed + dry * np.tanh(speed / 0.001)
        speed += h / parts * (-friction - gravity * np.sin(swing)) / inertia
        swing += h / parts * speed

import matplotlib.pyplot as plt

figure, ax = plt.subplots(figsize=(8, 3.2))
ax.plot(h * np.arange(201), np.degrees(path), color="0.7", lw=4, label="truth")
ax.plot(fall.t, np.degrees(fall.q[:, 0]), label="model, from the closed loop alone")
ax.set(xlabel="time (s)", ylabel="angle (deg)")
ax.legend()
figure.suptitle("Let go from 60° with the drive off")
figure.tight_layout()
figure

# %% [markdown]
# One C header for the drive's own controller, without dependencies:

# %%
print(f"{run.export('arm.h', 'c')} steps {1000 * run.h:g} ms at a time")
