# %% [markdown]
# # A double pendulum
#
# Two links with friction: the mass matrix depends on the angles. Positions only; the structure of a chain of
# pendulums is named (`pendulums`), its numbers are learned.

# %%
import herglotz as hz

data = hz.simulate(hz.scene("double_pendulum"), trajectories=4, steps=60, h=0.04, seed=0)
run = hz.fit(data, level="linear", features="pendulums", order=4)
print(run.summary())

# %% [markdown]
# The entries of the mass that depend on the angles have a row of their own: m₁₂ = ½ cos(θ₁ − θ₂) in units in which
# m₁₁ is 1.

# %%
run.plot("learned")

# %% [markdown]
# A motion that the fit has not seen, from another start. Motions of a double pendulum part exponentially: compare
# over seconds.

# %%
from herglotz.plots.motion import plot_prediction

other = hz.simulate(hz.scene("double_pendulum"), trajectories=1, steps=100, h=0.04, seed=7)
found = run.predict(other)
print("RMS:", found.rms)
plot_prediction(found)

# %% [markdown]
# And moving: `herglotz plot RUN --animate`, or

# %%
from herglotz.plots import save_animation

save_animation(run, "motion.gif", trajectory=2)
