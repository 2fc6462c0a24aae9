# %% [markdown]
# # Which numbers can I trust
#
# A fit prints numbers with digits in brackets, a verdict and an error. This page asks what each of them is worth, on a
# pendulum whose truth is known: θ″ = −4 sin θ − 0.1 θ′, swings of 0.4 rad for 15 s, 40 samples a second, 0.004 rad of
# noise.

# %%
import numpy as np

import herglotz as hz


def pendulum(amplitude, seed, h=0.025, count=600, parts=20):
    theta, omega, path = amplitude, 0.0, []
    for _ in range(count):
        path.append(theta)
        for _ in range(parts):
            omega += h / parts * (-4 * np.sin(theta) - 0.1 * omega)
            theta += h / parts * omega
    return np.array(path) + 0.004 * np.random.default_rng(seed).normal(size=count)


def fitted(q, h=0.025, angles=True):
    return hz.fit(q, h=h, coordinates="theta", angles=angles)


run = fitted(pendulum(0.4, seed=0))
print(run.equation())

# %% [markdown]
# **The digits in brackets** are standard deviations, of the noise alone: 4.01(2) is 4.01 ± 0.02. Are they true? Six
# recordings of the same motion with other noise, and how far both numbers are from the truth, in their own deviations:

# %%
misses = []
for seed in range(6):
    terms = {term.what: term for term in fitted(pendulum(0.4, seed)).equation().terms}
    pairs = [(terms["theta′"], -0.1), (terms["sin(theta)"], -4.0)]
    misses.append([(term.value - truth) / term.deviation for term, truth in pairs])
print(np.array2string(np.array(misses).T, precision=1))
print(f"root mean square: {np.sqrt(np.square(misses).mean()):.2f}")

# %% [markdown]
# They should be about 1. A deviation tells of the noise, and holds if the terms are the right ones.
#
# **The step** has a say, too: with longer steps a rule of order 2 fits a smaller stiffness. The equation therefore has
# the numbers to which those of the model tend as its steps get shorter. Of every fourth sample:

# %%
print(fitted(pendulum(0.4, seed=0)[::4], h=0.1).equation())

# %% [markdown]
# The last line says how far the equation, integrated exactly, departs from the model, 0.0002 times the error before and
# 0.002 times here. Above 1 the steps are too long for that: the numbers are then those of the model's own steps, and
# the rule of these steps stands below the equation. A deviation does not count this.
#
# **The verdict** compares the errors of free runs with the noise: on what was fitted, and on the last third of the
# time, which was not.

# %%
print(*run.metrics["verdict"].split(": ", 1), sep=":\n    ")

# %% [markdown]
# **The bands** carry the deviations along the motion. Nominal 90 %: how many held-out samples lie inside?

# %%
from herglotz.plots import plot_bands
from herglotz.training import laplace

bands = laplace(run).bands()
inside = bands.inside(run.data.unwrapped().q, 0.9)[run.train_lengths[0] :]
print(f"{100 * inside.double().mean():.0f} % of the {len(inside)} held-out samples")
plot_bands(run, bands)

# %% [markdown]
# **Beyond the recording** no band holds, and no verdict. Powers of θ fit small swings as well as the sine does; they
# are what a fit takes where the angle is read as a position on a line. A start at 2.5 rad tells them apart:

# %%
powers = fitted(pendulum(0.4, seed=0), angles=())
print(str(powers.equation()).splitlines()[0])
wide = hz.Trajectories.of(0.025 * np.arange(600), pendulum(2.5, seed=99), names=("theta",))
for name, model in (("sine", run), ("powers", powers)):
    verdict, error = model.metrics["verdict"].partition(":")[0], model.predict(wide).rms
    print(f"{name}: {verdict}; from 2.5 rad missed by {error:.2g} rad")

# %% [markdown]
# `predict` says that this motion is not one of the recorded kind:

# %%
print("beyond the recording:", run.predict(wide).beyond[0].words("s"))

# %% [markdown]
# **What the data cannot tell apart** has wide deviations each and a narrow one together. A fit says so below its
# equation, as that of [two masses](two_masses.md) does, and `herglotz trust` lists it.
#
# In short: trust the error over unseen time, and the verdict that compares it with the noise; trust a deviation if the
# terms are right; trust a sum before its parts; and trust nothing outside of the recorded range without a recording of
# it.
