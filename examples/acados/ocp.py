"""The problem of `examples/mpc_swing_up.py` for acados 0.6, which has to be installed: `python ocp.py` beside cart.c.

The file cart.c is written by `herglotz export RUN --format acados --out cart.c`; the shooting interval is the run's h.
acados copies the source by its name, so this script runs in the folder of the file.
"""

import casadi as ca
import numpy as np
from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

COUNT, H = 320, 0.00625  # the model's own step: H must be cart_c_h of the file
UPRIGHT = np.array([0.0, np.pi, 0.0, 0.0, 0.0])  # x, theta, their momenta, s

model = AcadosModel()
model.name = "cart"
model.x, model.u = ca.SX.sym("x", 5), ca.SX.sym("u", 1)
model.dyn_ext_fun_type = "generic"
model.dyn_generic_source = "cart.c"
model.dyn_disc_fun, model.dyn_disc_fun_jac = "cart_disc_fun", "cart_disc_fun_jac"

ocp = AcadosOcp()
ocp.model = model
ocp.solver_options.N_horizon, ocp.solver_options.tf = COUNT, COUNT * H
ocp.solver_options.integrator_type = "DISCRETE"
ocp.solver_options.hessian_approx = "GAUSS_NEWTON"  # the step has first derivatives
ocp.solver_options.nlp_solver_type = "SQP"
ocp.solver_options.qp_solver = "PARTIAL_CONDENSING_HPIPM"

ocp.cost.cost_type = ocp.cost.cost_type_e = "LINEAR_LS"
weight = np.diag([1.0, 2.0, 0.05, 0.5, 0.0])
ocp.cost.W, ocp.cost.W_e = np.diag([*np.diag(weight), 0.003]), 20 * weight
ocp.cost.Vx, ocp.cost.Vx_e = np.vstack([np.eye(5), np.zeros((1, 5))]), np.eye(5)
ocp.cost.Vu = np.array([[0.0]] * 5 + [[1.0]])
ocp.cost.yref, ocp.cost.yref_e = np.append(UPRIGHT, 0.0), UPRIGHT
ocp.constraints.x0 = np.zeros(5)
ocp.constraints.idxbu, ocp.constraints.lbu, ocp.constraints.ubu = np.array([0]), np.array([-12.0]), np.array([12.0])

solver = AcadosOcpSolver(ocp)
for k in range(COUNT + 1):
    solver.set(k, "x", UPRIGHT * k / COUNT)
print("status", solver.solve(), "first force", solver.get(0, "u"))
