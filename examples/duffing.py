# %% [markdown]
# # Duffing's oscillator, and the learned equation
#
# A spring that hardens: x″ = −0.15 x′ − x − 25 x³. Four hundred positions, 1 mm of noise, no velocities. Which
# equation do they obey?

# %%
import numpy as np


def acceleration(x, v):
    return -0.15 * v - x - 25 * x**3


h, small, x, v, positions = 0.02, 0.001, 0.5, 0.0, []
for _ in range(400):
    positions.append(x)
    for _ in range(round(h / small)):  # velocity Verlet
        v_half = v + small / 2 * acceleration(x, v)
        x += small * v_half
        v = v_half + small / 2 * acceleration(x, v_half)
q = np.array(positions) + 0.001 * np.random.default_rng(0).normal(size=400)

# %% [markdown]
# An array needs the time between two samples.

# %%
import herglotz as hz

run = hz.fit(q, h=h, coordinates="x")
print(run.equation())

# %%
print(run.summary())

# %% [markdown]
# What was learned, with bands of two standard deviations. The shaded range is where the data are: beyond it the model
# extrapolates.

# %%
from herglotz.plots import plot_learned
from herglotz.training import laplace

plot_learned(run, laplace(run))

# %% [markdown]
# The same with `herglotz trust RUN`: how many of the held-out samples lie in the 90 % band, and which parameters the
# data cannot tell apart.

# %%
from herglotz.plots import plot_bands

plot_bands(run, laplace(run).bands())
