# %% [markdown]
# # Two masses and a spring
#
# A motor turns a load through a coupling that gives: two inertias, a spring and a damper between them, friction in both
# bearings. Both shafts have an encoder; the motor's torque is recorded. Encoders count: 20 000 counts a turn here.

# %%
import numpy as np

J_motor, J_load, stiffness, damper = 2e-3, 6e-3, 9.0, 0.02  # kg·m², N·m/rad, N·m·s/rad
h, parts, rng = 0.004, 10, np.random.default_rng(3)
torque = np.repeat(0.4 * rng.normal(size=50), 20)  # N·m, a new level every 80 ms


def rates(x, u):
    motor, load, motor_rate, load_rate = x
    coupling = stiffness * (motor - load) + damper * (motor_rate - load_rate)
    forces = (u - coupling - 0.004 * motor_rate) / J_motor, (coupling - 0.008 * load_rate) / J_load
    return np.array([motor_rate, load_rate, *forces])


x, angles = np.zeros(4), []
for u in torque:
    angles.append(x[:2])
    for _ in range(parts):
        middle = x + h / parts / 2 * rates(x, u)
        x = x + h / parts * rates(middle, u)
count = 2 * np.pi / 20_000
angles = count * np.round(np.array(angles) / count)
table, header = np.c_[h * np.arange(1000), angles, torque], "t[s],motor[rad],load[rad],torque[N*m]"
np.savetxt("drive.csv", table, "%.7g", ",", header=header, comments="")

# %% [markdown]
# Columns in rad are taken for angles on a circle. A spring between two shafts that turn together is found as well.

# %%
import herglotz as hz

run = hz.fit("drive.csv")
print(run.summary())

# %% [markdown]
# The spring and the damper of the difference were found, and the friction of both bearings, with nothing told. The
# motor's inertia is the unit of mass, so that the gain of the torque is 1/J of the motor; divided by that gain, every
# other number is in SI units:

# %%
terms = run.equation().terms
number = {term.what: abs(term.value) for term in terms if term.left == "motor″"}
ratio = next(float(term.left.partition("(")[0]) for term in terms if term.left != "motor″")  # of the inertias
unit = 1 / number["torque"]
print(f"inertia of the motor  {1e3 * unit:.3f} g·m²        (truth {1e3 * J_motor:g})")
print(f"inertia of the load   {1e3 * unit * ratio:.3f} g·m²        (truth {1e3 * J_load:g})")
print(f"spring                {unit * number['(motor − load)']:.3f} N·m/rad      (truth {stiffness:g})")
print(f"damper                {unit * number['(motor′ − load′)']:.4f} N·m·s/rad   (truth {damper:g})")

# %% [markdown]
# Behind a gear the spring is one of 0.2 motor − load, say. Where both shafts turn once at least and the coupling is not
# too stiff, the fit finds this ratio; else give the motor's angle at the load's side, `sensor_scales=(0.2, 1)`
# (`--sensor-scales`).

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
