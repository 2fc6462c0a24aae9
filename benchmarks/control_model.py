"""A learned cart with its pendulum, for `benchmarks/control.py`: as a model, and as expressions of CasADi alone.

The numbers are those that `examples/mpc_swing_up.py` learns of its recordings; the fit is not repeated.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import torch

from herglotz.models import ContactLagrangian, ModelConfig

H = 0.00625  # s: the model's own step
FACTOR = ((1.0, 0.0), (0.00031584926745, 0.23984877))  # C of the mass m = C Cᵀ
COUPLING, STIFFNESS, RATE = 0.11501273180, 1.12807918135, 0.00105678298
VISCOUS, DRAG = (0.30569501943, 0.00761698943), -0.00528029567
INPUTS = (0.76955898360, 0.00029280290)  # input map of the friction term
ITERATIONS = 3  # of Newton from q1 = q0: a fourth changes a step by rounding alone


def model() -> ContactLagrangian:
    """The model."""
    config = ModelConfig(
        angles=(False, True), level="forced", scale=(0.55, 2.8), speed=(2.4, 8.5), stiffness=(0.0, STIFFNESS),
        tilt=(0.0, 0.0), rate=RATE, potential_width=0, inputs=1, features=("cos(q2) v1 v2",), drag=("q1 v1",),
    )  # fmt: skip
    made = ContactLagrangian(config)
    double: Any = {"dtype": torch.float64}
    numbers = {
        "kinetic.base.log_diagonal": torch.tensor(FACTOR[1][1], **double).log(),
        "kinetic.base.off_diagonal": torch.tensor(FACTOR[1][0], **double),
        "kinetic.sum.coefficient": torch.tensor(COUPLING, **double),
        "friction.viscous": torch.tensor(VISCOUS, **double),
        "friction.input_map": torch.tensor(INPUTS, **double),
        "drag.coefficient": torch.tensor(DRAG, **double),
    }
    with torch.no_grad():
        for name, value in numbers.items():
            parameter = made.get_parameter(name)
            parameter.copy_(value.reshape(parameter.shape))
    return made


def _equation(q0: Any, p0: Any, s0: Any, q1: Any, u: Any, h: Any) -> tuple[Any, Any, Any]:
    """D1 L_d + F⁻ + c p0, p1 = D2 L_d + F⁺ and s1 = s0 + L_d, of SX symbols."""
    C, delta, middle = ca.DM(FACTOR), q1 - q0, (q0 + q1) / 2
    v, c = delta / h, ca.exp(-RATE * h)
    K = ca.dot(v, C @ (C.T @ delta)) / 2 + h * COUPLING * ca.cos(middle[1]) * v[0] * v[1]
    V0, V1 = (STIFFNESS * (1 - ca.cos(q[1])) for q in (q0, q1))
    L = (c - 1) * (s0 - h / 2 * V0) + ca.sqrt(c) * K - h / 2 * (V0 + V1)
    force = ca.DM(INPUTS) * u - ca.DM(VISCOUS) * v - ca.vertcat(DRAG * middle[0] * v[0], 0)
    return ca.gradient(L, q0) + c * h / 2 * force + c * p0, ca.gradient(L, q1) + h / 2 * force, s0 + L


def sx_steps() -> dict[str, ca.Function]:
    """The step (x, u, h) → x1 in CasADi alone: Newton unrolled in SX, and CasADi's own `fast_newton` on SX."""
    q0, q1, p0 = (ca.SX.sym(name, 2) for name in ("q0", "q1", "p0"))
    s0, u, h = (ca.SX.sym(name) for name in ("s0", "u", "h"))
    residual, p1, s1 = _equation(q0, p0, s0, q1, u, h)
    x = ca.vertcat(q0, p0, s0)
    newton = ca.Function("newton", [q1, x, u, h], [q1 - ca.inv(ca.jacobian(residual, q1)) @ residual])
    end = ca.Function("end", [q1, x, u, h], [ca.vertcat(q1, p1, s1)])
    q = q0
    for _ in range(ITERATIONS):
        q = newton(q, x, u, h)
    unrolled = ca.Function("unrolled", [x, u, h], [end(q, x, u, h)])
    root = ca.rootfinder("root", "fast_newton", ca.Function("residual", [q1, x, u, h], [residual]), {"abstol": 1e-13})
    x, u, h = ca.MX.sym("x", 5), ca.MX.sym("u"), ca.MX.sym("h")
    return {"unrolled": unrolled, "rootfinder": ca.Function("found", [x, u, h], [end(root(x[:2], x, u, h), x, u, h)])}
