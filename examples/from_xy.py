# %% [markdown]
# # From x, y to an angle
#
# A tracking program follows a pendulum's bob in a video, and writes x and y. The motion has one freedom, not two: the
# bob stays on a circle. This page makes such a file: 25 frames a second, 1 mm of noise, a pivot somewhere in the
# picture. The first line names the body, as Tracker writes it.

# %%
from pathlib import Path

import numpy as np

h, rng, length, pivot = 0.04, np.random.default_rng(1), 0.62, (0.31, 0.87)
theta, omega, angles = 0.9, 0.0, []
for _ in range(250):
    angles.append(theta)
    for _ in range(40):  # θ″ = −g/ℓ sin θ − 0.15 θ′ in small steps
        omega += h / 40 * (-9.81 / length * np.sin(theta) - 0.15 * omega)
        theta += h / 40 * omega
angles = np.array(angles)
x = pivot[0] + length * np.sin(angles) + 0.001 * rng.normal(size=250)
y = pivot[1] - length * np.cos(angles) + 0.001 * rng.normal(size=250)
np.savetxt("video.csv", np.c_[h * np.arange(250), x, y], "%.5f", ",", header="mass_A\nt[s],x[m],y[m]", comments="")
print(*Path("video.csv").read_text().splitlines()[:4], sep="\n")

# %% [markdown]
# `polar="x,y"` makes one angle of the two columns: 0 where the bob hangs, growing towards +x. Centre and radius of the
# circle are found by least squares. In pictures whose y grows downwards it is `polar="x,-y"`; a chain of bodies has one
# pair each, `polar=["x1,y1", "x2,y2"]`. Columns of several bodies that are all called x and y get the names in the line
# above them, `mass_A_x`, `mass_B_x`. If the length changes, a warning says so, and `polar="x,y,X,Y,r"` with the
# centre keeps it as a coordinate r.

# %%
import herglotz as hz

data = hz.load("video.csv", polar="x,y", show=False)
print(data)
print(*data.notes, sep="\n")

# %% [markdown]
# Look at the circle before believing it.

# %%
import matplotlib.pyplot as plt

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
left.plot(x, y, ".", ms=3)
left.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="What the camera sees")
right.plot(data.t, data.q, ".", ms=3)
right.set(xlabel="time (s)", ylabel="angle (rad)", title="What moves")
figure.suptitle("A circle, and the angle on it")
figure.tight_layout()
figure

# %%
run = hz.fit("video.csv", polar="x,y")
print(run.summary())

# %% [markdown]
# The factor of the sine is g/ℓ, so that the pendulum measures its own length, which the camera saw too:

# %%
factor = next(term.value for term in run.equation().terms if "sin" in term.what)
print(f"{9.81 / abs(factor):.4f} m by the motion, {length} m in truth")

# %% [markdown]
# The same by a command: `herglotz fit video.csv --polar x,y --out runs/video`. `predict` makes the angle of another
# recording with the same circle.
