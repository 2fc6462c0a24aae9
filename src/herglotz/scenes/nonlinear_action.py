"""Two degrees of freedom, nonlinear in s: no block of second derivatives of L_d is zero.

L = ½(1 + .3 sin q1)v1² + .6v2² + .2v1v2 − cos(q1q2) − ¼|q|² − a[.3s + .1 sin(s)(1 + .2q2) + .05 s v1]. The system is no
model of a machine: an exchanged index, a transposed block or a c that is taken for constant changes its motion.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.scenes.natural import scene_without_closed_form
from herglotz.scenes.scene import Scene


def nonlinear_action(damping: float = 1.0) -> Scene:
    """The two-degree-of-freedom system of section 4 of `docs/mathematics.md`.

    Parameters
    ----------
    damping
        Factor a of all terms in s; 0 is conservative.
    """
    drag = 0.05 * damping

    def lagrangian(q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        (q1, q2), (v1, v2) = q.unbind(-1), v.unbind(-1)
        kinetic = 0.5 * (1 + 0.3 * torch.sin(q1)) * v1**2 + 0.6 * v2**2 + 0.2 * v1 * v2
        return kinetic - torch.cos(q1 * q2) - 0.25 * (q1**2 + q2**2) - dissipation(q2, s) - drag * s * v1

    def dissipation(q2: Tensor, s: Tensor) -> Tensor:
        return damping * (0.3 * s + 0.1 * torch.sin(s) * (1 + 0.2 * q2))

    def velocity(q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        p1, p2, m = p[..., 0] + drag * s, p[..., 1], 1 + 0.3 * torch.sin(q[..., 0])
        return torch.stack([1.2 * p1 - 0.2 * p2, m * p2 - 0.2 * p1], -1) / (1.2 * m - 0.04)[..., None]

    def force(q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        q1, q2 = q.unbind(-1)
        wave = torch.sin(q1 * q2)
        f1 = 0.15 * torch.cos(q1) * v[..., 0] ** 2 + q2 * wave - 0.5 * q1
        return torch.stack([f1, q1 * wave - 0.5 * q2 - 0.02 * damping * torch.sin(s)], -1)

    def rate(q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        return -damping * (0.3 + 0.1 * torch.cos(s) * (1 + 0.2 * q[..., 1])) - drag * v[..., 0]

    return scene_without_closed_form(
        name="nonlinear_action",
        description="two degrees of freedom, nonlinear in s; no closed form, reference flow to about 1e-13",
        coordinates=("q1", "q2"),
        units=("1", "1"),
        time_unit="1",
        parameters={"damping": damping},
        lagrangian=lagrangian,
        velocity=velocity,
        force=force,
        rate=rate,
        q_range=(-1.0, 1.0),
        v_range=(-1.0, 1.0),
        h=0.2,
        examples=({"damping": 1.5},),
    )
