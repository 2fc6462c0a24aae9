# %% [markdown]
# # Train your own L_d
#
# You have a `torch.nn.Module` and recorded positions, and want a stepper that is a contact integrator whatever the
# weights are. Write the discrete Lagrangian L_d(q0, q1, s0, h): the increment of the action s over one step, one number
# a sample. Here the kinetic energy is known, the potential is a network, and −γs damps (`.sum(-1)` over coordinates,
# `h[..., None]` beside them).

# %%
import torch
from torch import nn

import herglotz as hz


class Pendulum(nn.Module):
    def __init__(self):
        super().__init__()
        self.V = nn.Sequential(nn.Linear(1, 8), nn.Tanh(), nn.Linear(8, 1))
        self.gamma = nn.Parameter(torch.tensor(0.0))

    def forward(self, q0, q1, s0, h):
        v = (q1 - q0) / h[..., None]
        V = (self.V(q0) + self.V(q1))[..., 0] / 2
        return h * ((v * v).sum(-1) / 2 - V - self.gamma * s0)


data = hz.simulate(hz.scene("damped_pendulum"), trajectories=4, steps=60, h=0.1, noise=0.002, seed=0)
torch.manual_seed(0)
net = Pendulum()
run = hz.fit(data, model=net, robust="off", iterations=40)
print(f"gamma = {net.gamma.item():.3f} (0.2 is true)\n{run.summary()}")

# %% [markdown]
# `fit` has trained `net` in place: one-step errors J⁻¹R by Levenberg–Marquardt, then whole trajectories, as the data
# are noisy. What comes back is a `Run` that steps, predicts, draws, verifies and exports.

# %%
run.plot("trajectory")

# %%
report = run.verify(h=0.1)
print(report.table())

# %% [markdown]
# C is traced from the module: any L_d is written whose operations are known; the message names the one that is not.

# %%
from herglotz.export import load_c

stepper = load_c(run.export("pendulum.h"), trust_code=True)
q, p, s = run.states_at_end()
ours, eager = (x.rollout(q, p, s, h=0.1, steps=200) for x in (stepper, run.stepper))
print(f"C and PyTorch differ by {(ours.q - eager.q).abs().max():.1e} after 200 steps")

# %% [markdown]
# ## A loop of your own
#
# `hz.losses.herglotz_residual` gives J⁻¹R, in units of q, for any optimiser, dtype and device: the error of each next
# position, to first order. Minibatches are windows of three samples and more, stacked. The raw residual R is no loss:
# it is a tenth for a tenth of L_d, which has the same motion.

# %%
q = data.q.reshape(4, -1, 1).float()
windows = q.unfold(1, 8, 4).mT.flatten(0, 1)  # (B, 8, 1)
net = Pendulum()
optimiser = torch.optim.Adam(net.parameters(), 1e-2)
for step in range(201):
    batch = windows[torch.randint(len(windows), (32,))]
    loss = hz.losses.herglotz_residual(net, batch, 0.1).square().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    if step % 100 == 0:
        print(f"{step:4d}  RMS of J⁻¹R {loss.sqrt():.2e} rad")

# %% [markdown]
# Noise of σ leaves √6 σ in a one-step error, and biases what is learned. `hz.losses.shooting` misses whole trajectories
# instead: their starts are trained beside L_d, and gradients go through every step by the implicit-function theorem.

# %%
starts = hz.losses.starts(q, length=30)
optimiser = torch.optim.Adam([*net.parameters(), *starts], 2e-3)
for step in range(21):
    loss = hz.losses.shooting(net, q, 0.1, starts, length=30).loss
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    if step % 10 == 0:
        print(f"{step:4d}  RMS of segments {loss.sqrt():.2e} rad")

# %% [markdown]
# ## Rollouts
#
# A stepper of L_d starts at a position and a velocity, and takes steps of any lengths, as `t.diff()` of a grid of
# times. Gradients go through all of them.

# %%
stepper = hz.Stepper(net)
t = torch.tensor([0.0, 0.1, 0.2, 0.4, 0.6])
start = stepper.init_qv(torch.tensor([1.0]), torch.tensor([0.0]), h=0.1)
motion = stepper.rollout(*start, h=t.diff(), steps=len(t) - 1)
v = stepper.velocity(motion.states, h=0.1)
net.zero_grad()
motion.q[-1, 0].backward()
print(f"q {motion.q[-1, 0]:.3f} rad, q′ {v[-1, 0]:.3f} rad/s at {t[-1]:.1f} s; ∂q/∂γ {net.gamma.grad:.3f} rad s")
