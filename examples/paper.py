# %% [markdown]
# # The paper's figures: a parachute, and the discrete Hamilton–Jacobi equation
#
# O. Esen, C. Sardón and M. Zajac let a parachute fall: L = K − V with quadratic drag as a contact term. Their printed
# map and the fall that follows from the corrected one ([errata](../errata.md)):

# %%
from herglotz.plots import plot_fall, plot_printed_map
from herglotz.plots.parachute import physical_fall, printed_map

plot_printed_map(printed_map())

# %%
plot_fall(physical_fall())

# %% [markdown]
# A discrete contact Lagrangian has a discrete Hamilton–Jacobi equation: the action along its solutions, S^k,
# generates the momenta. Both hold to rounding for every L_d. `verify` measures them, on a scene, a trained run or an
# exported file.

# %%
from herglotz.verify import verify

print(verify("parachute").table())

# %%
import herglotz as hz
from herglotz.plots import plot_momentum_vs_generating_function

plot_momentum_vs_generating_function(hz.scene("damped_pendulum"))

# %%
from herglotz.plots import plot_hamilton_jacobi_residual

plot_hamilton_jacobi_residual(hz.scene("damped_pendulum"))
