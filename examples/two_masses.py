# %% [markdown]
# # Two masses and a spring
#
# A motor turns a load through a coupling that gives: two inertias, a spring and a damper between them, friction in both
# bearings. Both shafts have an encoder; the motor's torque is recorded. Encoders count: 20 000 counts a turn here.

# %%
import numpy as np

J_motor, J_load, stiffness, damper = 2e-3, 6e-3, 9.0, 0.02  # kg·m², N·m/rad, N·m·s/rad
h, parts, rng = 0.004, 40, np.random.default_rng(3)
torque = np.repeat(0.4 * rng.normal(size=50), 20)  # N·m, a new level every 80 ms
a, b, va, vb, angles = 0.0, 0.0, 0.0, 0.0, []
for u in torque:
    angles.append((a, b))
    for _ in range(parts):
        coupling = stiffness * (a - b) + damper * (va - vb)
        va += h / parts * (u - coupling - 0.004 * va) / J_motor
        vb += h / parts * (coupling - 0.008 * vb) / J_load
        a, b = a + h / parts * va, b + h / parts * vb
count = 2 * np.pi / 20_000
angles = count * np.round(np.array(angles) / count)
table, header = np.c_[h * np.arange(1000), angles, torque], "t[s],motor[rad],load[rad],torque[N*m]"
np.savetxt("drive.csv", table, "%.7g", ",", header=header, comments="")

# %% [markdown]
# Columns in rad are taken for angles on a circle, whose spring between two that turn together is found as well.
# Nothing holds this drive at an angle: `angles=()` reads both as positions on a line (`--angles none`).

# %%
import herglotz as hz

run = hz.fit("drive.csv", angles=())
print(run.summary())

# %% [markdown]
# The spring and the damper of the difference were found, with nothing told. The motor's inertia is the unit of mass, so
# that the gain of the torque is 1/J of the motor; divided by that gain, every other number is in SI units:

# %%
number = {term.what: abs(term.value) for term in run.equation().terms}
unit = 1 / number["torque"]
print(f"inertia of the motor  {1e3 * unit:.3f} g·m²        (truth {1e3 * J_motor:g})")
print(f"inertia of the load   {2e3 * unit * number['load′²']:.3f} g·m²        (truth {1e3 * J_load:g})")
print(f"spring                {2 * unit * number['(motor − load)²']:.3f} N·m/rad      (truth {stiffness:g})")
print(f"damper                {unit * number['(motor′ − load′)']:.4f} N·m·s/rad   (truth {damper:g})")

# %% [markdown]
# Two things need a second look. The factor of s is a damping rate of both shafts together, and the friction of the load
# is the difference to it. And the fit took small terms beside those of the truth, which it says are hard to tell apart:
# read none of them as physics.
#
# Behind a gear of ratio i the spring is one of motor / i − load: give the motor's angle at the load's side,
# `sensor_scales=(1 / i, 1)` (`--sensor-scales`).

# %%
run.plot()

# %% [markdown]
# A torque that the recording did not have, 0.5 N·m for 0.1 s from rest. The model takes several steps between two
# samples of the recording; `run.h` is its own.

# %%
steps = round(0.5 / run.h)
push = np.where(run.h * np.arange(steps) < 0.1, 0.5, 0.0)
moved = run.rollout(steps, q0=[0.0, 0.0], p0=[0.0, 0.0], inputs=push)

import matplotlib.pyplot as plt

figure, ax = plt.subplots(figsize=(8, 3.2))
ax.plot(moved.t, 1000 * (moved.q[:, 0] - moved.q[:, 1]))
ax.set(xlabel="time (s)", ylabel="motor − load (mrad)")
figure.suptitle("The coupling rings after a push")
figure.tight_layout()
figure
