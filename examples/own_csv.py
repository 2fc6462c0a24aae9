# %% [markdown]
# # Your own csv
#
# You have a table of times and positions, and want a model that goes on where the recording ends. This page makes
# such a table with numpy: a damped pendulum, 0.003 rad of noise. Your own file takes its place; the rest stays the
# same.

# %%
import numpy as np

h, rng = 0.1, np.random.default_rng(0)
t, theta, omega = h * np.arange(240), [1.2], 0.0
for _ in t[1:]:
    x = theta[-1]
    for _ in range(100):  # θ″ = −sin θ − 0.2 θ′ in small steps
        omega += h / 100 * (-np.sin(x) - 0.2 * omega)
        x += h / 100 * omega
    theta.append(x)
measured = np.array(theta) + 0.003 * rng.normal(size=len(t))
table, header = np.c_[t, measured], "t[s],theta[rad]"
np.savetxt("pendulum.csv", table, "%.6f", ",", header=header, comments="")

# %% [markdown]
# The unit rad marks an angle. `hz.fit` prints what it takes each column for, holds out the last third of the time,
# decides how to fit, and judges the result by a free run over what it did not see.

# %%
import herglotz as hz

run = hz.fit("pendulum.csv")
print(run.summary())

# %% [markdown]
# The verdict is the last line. The learned equation has standard deviations in brackets, of the last digits: 0.200(1)
# is 0.200 ± 0.001. The truth here is 1 and 0.2.

# %%
run.plot()

# %% [markdown]
# Why did the fit do what it did? Every decision has its reason.

# %%
run.plot("plan")

# %% [markdown]
# Go on from the end of the training data, check the identities that hold for every discrete contact Lagrangian, and
# export a C header without dependencies.

# %%
future = run.rollout(50)
print(future)
print("verified:", run.verify().passed)
print(run.export("pendulum.h"))

# %% [markdown]
# `run.report("report")` writes all of this, and what the data leave open, on one HTML page. The same by commands:
# `herglotz fit pendulum.csv --out runs/pendulum`, `herglotz report runs/pendulum`, `herglotz export runs/pendulum
# --out pendulum.h`.
