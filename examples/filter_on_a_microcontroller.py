# %% [markdown]
# # A filter on a microcontroller
#
# A controller reads an encoder and needs velocities. Differences of positions are noisy, and what smooths them comes
# late; a filter that knows the motion is neither. This page goes from a recording to a Kalman filter in C: in single
# precision, without allocation, as a microcontroller runs it.
#
# A pendulum with a motor, recorded at 50 Hz by an encoder whose steps are a third of a degree:

# %%
import numpy as np

import herglotz as hz

h, parts, step, rng = 0.02, 40, np.radians(1 / 3), np.random.default_rng(3)


def moved(theta, omega, torque):
    """The state 20 ms later: θ'' = 8 τ − 25 sin θ − 0.4 θ'."""
    for _ in range(parts):
        omega += h / parts * (8 * torque - 25 * np.sin(theta) - 0.4 * omega)
        theta += h / parts * omega
    return theta, omega


def recorded(count, theta=0.8, unknown=0.0):
    """Times, encoder readings, torques and, for comparison, the velocity."""
    t, omega, rows = h * np.arange(count), 0.0, []
    torque = np.repeat(rng.uniform(-2, 2, count // 25 + 1), 25)[:count]
    for now, acting in zip(t, torque, strict=True):
        rows.append((now, step * np.round(theta / step), acting, omega))
        theta, omega = moved(theta, omega, acting + unknown * rng.normal())
    return np.array(rows).T


t, theta, torque, _ = recorded(800)
run = hz.fit({"t[s]": t, "theta[rad]": theta, "torque[N*m]": torque}, train_fraction=1.0)
print(run.equation())

# %% [markdown]
# The header has the step, its derivative and the filter, with the noise that the fit found as `arm_noise_of_fit`.

# %%
run.export("arm.h", extras=["filter"], dtype="float32")
print(f"{round(h / run.h)} steps of {1000 * run.h:g} ms a sample")

# %% [markdown]
# The loop of the controller: a reading comes, the filter steps to it and takes it in. The fit knows the noise of the
# readings; how large the forces are that the model does not know is ours to say: torques of 0.05 N·m, others at each
# sample, give an arm of 8 rad/s² a N·m (whose mass is the unit, 1) a momentum of 0.05 · 8 · √0.02 a root second.

# %%
from pathlib import Path

_ = Path("loop.c").write_text("""
#include <stdio.h>
#include "arm.h"

int main(void) {
  enum { STEPS = 16 }; /* of the model, in a sample */
  static arm_filter filter; /* all that is kept between two samples */
  arm_noise noise = arm_noise_of_fit;
  const float std[arm_F] = {0.01f, 3.0f};
  arm_state x = arm_start;
  float theta, torque, before = 0.0f, v, variance;
  int status, k, i;
  noise.momentum[0] = 0.057f;
  for (k = 0; scanf("%f %f", &theta, &torque) == 2; k++, before = torque) {
    if (k == 0) {
      x.q[0] = theta;
      x.p[0] = 0.0f;
      status = arm_filter_start(&filter, &x, std);
    } else {
      for (status = i = 0; i < STEPS && !(status & 15); i++)
        status = arm_filter_predict(&filter, 0.02f / STEPS, &before, &noise);
      if (!(status & 15)) status = arm_filter_update(&filter, &theta, &noise, 0);
    }
    if (!(status & 15)) status = arm_filter_velocity(&filter, arm_h, &torque, &v, &variance);
    if (status & 15) return status; /* the filter is as it was before */
    printf("%g %g %g\\n", filter.x.q[0], v, sqrtf(variance));
  }
  fprintf(stderr, "%d samples, %d bytes\\n", k, (int)sizeof filter);
  return 0;
}
""")

# %% [markdown]
# Another recording, of other torques, goes through it; there the arm is pushed, too. On this machine the compiler is
# `cc`; for a Cortex-M4F it is `arm-none-eabi-gcc -mcpu=cortex-m4 -mfloat-abi=hard`, with the same file.

# %%
import subprocess

t, theta, torque, omega = recorded(300, theta=-0.5, unknown=0.05)
subprocess.run(["cc", "-O2", "-std=c99", "loop.c", "-o", "loop", "-lm"], check=True)
lines = "".join(f"{a:.6g} {b:.6g}\n" for a, b in zip(theta, torque, strict=True))
done = subprocess.run("./loop", input=lines, capture_output=True, text=True, check=True)
q, v, std = np.loadtxt(done.stdout.splitlines()).T
print(done.stderr)

# %% [markdown]
# Differences of readings are what one would have without a model. `hz.filter` is the same filter in Python, in double
# precision, and with `lag=10` a fixed-lag smoother: each velocity waits for ten samples (0.2 s).

# %%
from herglotz.data import as_trajectories
from herglotz.export import noise_of

again = as_trajectories({"t[s]": t, "theta[rad]": theta, "torque[N*m]": torque})
differences = np.diff(theta, prepend=theta[0]) / h
late = slice(25, None)  # after half a second
noise = noise_of(run)._replace(momentum=(0.057,))
filtered, smooth = (hz.filter(run, again, noise=noise, lag=lag).v[:, 0].numpy() for lag in (0, 10))
for name, found in (
    ("differences", differences), ("filter in C", v), ("the same in Python", filtered),
    ("0.2 s later", smooth),
):  # fmt: skip
    print(f"{name:19} {np.sqrt(np.mean((found - omega)[late] ** 2)):.3f} rad/s")

# %%
import matplotlib.pyplot as plt

figure, (ax, below) = plt.subplots(2, sharex=True, figsize=(8, 4.6))
for name, found in (("differences of readings", differences), ("filter in C", v), ("0.2 s later", smooth)):
    ax.plot(t, found - omega, label=name)
ax.set(ylabel="error (rad/s)")
ax.legend(ncols=3, fontsize=8)
below.fill_between(t, -2 * std, 2 * std, color="0.85", label="±2 standard deviations")
below.plot(t, v - omega, color="tab:orange", label="filter in C")
below.set(xlabel="time (s)", ylabel="error (rad/s)", ylim=(-0.2, 0.2))
below.legend(ncols=2, fontsize=8)
figure.suptitle("Errors of velocities, from an encoder with steps of a third of a degree")
figure.tight_layout()
figure
