"""Break the geometry on purpose, one line at a time, and see whether the tests notice: `make mutants`.

Each mutant is a sign, a factor or an index that one could get wrong and still have a program that runs. It is tried on
a copy of the sources; the tests that should kill it are named beside it, and the first that does is printed.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

ROOT = Path(__file__).resolve().parents[1]
M, S, K, V = "tests/unit/mechanics", "tests/unit/scenes", "tests/unit/stepping", "tests/verification"
T = "tests/unit/theory"
MUTANTS = [
    # mechanics
    ("mechanics/legendre.py", "return -D1 / P.c[..., None]", "return -D1", f"{M}/test_partials.py::test_legendre_transforms_of_the_exact_lagrangian"),
    ("mechanics/legendre.py", "P.D1 if P.force is None else P.D1 + P.force.minus", "P.D1", f"{M}/test_forces.py::test_a_step_solves_the_forced_equations"),
    ("mechanics/legendre.py", "P.D2 if P.force is None else P.D2 + P.force.plus", "P.D2", f"{M}/test_forces.py::test_a_step_solves_the_forced_equations"),
    ("mechanics/legendre.py", "return q1, momentum_plus(P), s0 + P.L", "return q1, momentum_plus(P), s0 - P.L", f"{M}/test_partials.py::test_legendre_transforms_of_the_exact_lagrangian"),
    ("mechanics/legendre.py", "F = P.D1 + P.c[..., None] * p0", "F = P.D1 + p0", f"{M}/test_partials.py::test_herglotz_residual_vanishes_along_a_flow_and_only_there"),
    ("mechanics/legendre.py", "F if P.force is None else F + P.force.minus", "F", f"{M}/test_forces.py::test_a_step_solves_the_forced_equations"),
    ("mechanics/legendre.py", "J = P.D12 + p0[..., :, None]", "J = P.D12 - p0[..., :, None]", f"{M}/test_partials.py::test_m_is_the_momentum_jacobian_on_the_solution"),
    ("mechanics/tangent.py", "F_q0 = P.D11 + p0", "F_q0 = P.D11 - p0", f"{M}/test_partials.py::test_step_derivative_is_the_derivative_of_the_step"),
    ("mechanics/tangent.py", "p1_q0, p1_q1, p1_s0 = P.D12.mT,", "p1_q0, p1_q1, p1_s0 = P.D12,", f"{M}/test_partials.py::test_step_derivative_is_the_derivative_of_the_step"),
    ("mechanics/tangent.py", "p1_q0 + P.force.plus_1", "p1_q0 - P.force.plus_1", f"{M}/test_forces.py::test_the_derivative_of_a_forced_step_is_the_closed_form"),
    ("mechanics/tangent.py", "zero[..., 0], P.c[..., None]], -1)", "zero[..., 0], P.D3[..., None]], -1)", f"{M}/test_partials.py::test_step_derivative_is_the_derivative_of_the_step"),
    ("mechanics/contact.py", "torch.cat([-p, torch.zeros_like(p)", "torch.cat([p, torch.zeros_like(p)", "tests/contracts/test_model_contract.py::test_a_step_is_a_contact_map"),
    ("mechanics/partials.py", "D12=torch.stack([r[1] for r in rows0], -2)", "D12=torch.stack([r[1] for r in rows0], -1)", f"{M}/test_partials.py::test_d12_is_not_symmetrised"),
    ("theory/hamiltonian.py", "return (p1 * q1).sum(-1) - L", "return (p1 * q1).sum(-1) + L", f"{S}/test_scenes.py::test_right_hamiltonian"),
    ("theory/hamiltonian.py", "return -(p0 * q0).sum(-1) - L", "return (p0 * q0).sum(-1) - L", f"{T}/test_left_formalism.py::test_hamiltonian_derivatives"),
    ("theory/hamiltonian.py", "D11=B @ P.D12.mT - P.D11", "D11=B @ P.D12.mT + P.D11", f"{T}/test_left_formalism.py::test_hamiltonian_derivatives"),
    ("theory/left.py", "(b3 + P.D33[..., None] * b)", "b3", f"{T}/test_left_formalism.py::test_left_second_derivatives_against_autograd"),
    ("theory/hamilton_equations.py", "-P.D2 / (1 + P.D3)[..., None]", "-P.D2 / (1 - P.D3)[..., None]", f"{T}/test_left_formalism.py::test_both_sets_of_equations_on_the_flow"),
    ("theory/hamilton_equations.py", "s1 + P.L - (p0", "s1 - P.L - (p0", f"{T}/test_left_formalism.py::test_both_sets_of_equations_on_the_flow"),
    ("theory/action.py", "P.c[..., 1:].flip(-1)", "P.c[..., :-1].flip(-1)", f"{T}/test_action.py::test_gradient_against_autograd"),
    ("theory/generating.py", "S1 - S0 + (dS0 * q0)", "S1 - S0 - (dS0 * q0)", f"{V}/test_left_rows.py::test_the_left_rows_pass"),
    ("theory/generating.py", "D1 = (1 - D3)[..., None] * D", "D1 = D", f"{V}/test_discrete_hamilton_jacobi.py::test_generating_functions_right_and_left"),
    ("theory/generating.py", "D3 = G_s - 1.0", "D3 = G_s", f"{V}/test_identities.py::test_random_models_are_contact_integrators"),
    ("theory/generating.py", "S1 - S0 - (dS1 * q1)", "S1 - S0 + (dS1 * q1)", f"{V}/test_discrete_hamilton_jacobi.py::test_theorem_2_right_and_left_equations_hold_on_an_open_set"),
    ("theory/hamilton_jacobi.py", "P.D22 - P.D12.mT @ pivot_B", "P.D22 - P.D12 @ pivot_B", f"{T}/test_hopf_lax.py::test_riccati_of_two_coupled_coordinates"),
    ("theory/hamilton_jacobi.py", "c * S.delta - 0.5 * c**2", "c * S.delta - 0.5 * c", f"{T}/test_hopf_lax.py::test_riccati_by_the_formula"),
    ("mechanics/regularity.py", "return P.D11 + cross + cross.mT", "return P.D11 + cross", f"{T}/test_left_formalism.py::test_the_hessian_that_decides_about_the_left_hamiltonian"),
    ("theory/continuous.py", "-(H_q + p * H_s[..., None])", "-H_q", f"{T}/test_contact_geometry.py::test_the_contact_field_by_its_characterisation"),
    ("theory/continuous.py", "return q_dot, p_dot, heat - H_value", "return q_dot, p_dot, heat", f"{T}/test_contact_geometry.py::test_the_contact_field_by_its_characterisation"),
    ("theory/continuous.py", "(P.D12.mT @ v", "(P.D12 @ v", f"{T}/test_continuous_legendre.py::test_herglotz_equations_are_the_contact_hamilton_equations"),
    ("theory/jacobi.py", "- F.L * G.D3 + G.L * F.D3", "+ F.L * G.D3 - G.L * F.D3", f"{T}/test_contact_geometry.py::test_bracket_is_the_commutator_of_contact_fields"),
    ("theory/legendrian.py", "return -(s0 + S(q0, q1, s0))", "return s0 + S(q0, q1, s0)", f"{T}/test_legendrian.py::test_the_generating_function_has_a_minus_sign"),
    ("theory/hj_on_qxr.py", "- P.L[..., None] * g_s", "+ P.L[..., None] * g_s", f"{T}/test_hj_sections.py::test_the_golden_section_on_QxR"),
    ("theory/noether.py", "value - shift(e[..., 0], q)", "value + shift(e[..., 0], q)", f"{V}/test_contact_noether.py::test_generators_and_momenta"),
    ("theory/jacobi.py", "join(-X_p - along[..., None] * p, X_q", "join(-X_p + along[..., None] * p, X_q", f"{T}/test_contact_geometry.py"),
    ("theory/jacobi.py", "(X_q * Y_p).sum(-1) - (X_p * Y_q)", "(X_q * Y_p).sum(-1) + (X_p * Y_q)", f"{T}/test_contact_geometry.py"),
    ("theory/jacobi.py", "return turned - join(X_p", "return turned + join(X_p", f"{T}/test_contact_geometry.py"),
    ("theory/jacobi.py", "a_s + (p * a_p).sum(-1))", "(p * a_p).sum(-1))", f"{T}/test_contact_geometry.py"),
    ("theory/continuous.py", "force = P.D1 + P.D3[..., None] * P.D2", "force = P.D1 - P.D3[..., None] * P.D2", f"{T}/test_continuous_legendre.py"),
    ("theory/continuous.py", "- L_vq_v - P.L[..., None] * P.D23", "- L_vq_v", f"{T}/test_continuous_legendre.py"),
    ("theory/legendre_dual.py", "(x * y).sum(-1) - f(q, x, s)", "(x * y).sum(-1) + f(q, x, s)", f"{T}/test_continuous_legendre.py"),
    ("theory/hj_on_q.py", "(F_q * v).sum(-1))", "-(F_q * v).sum(-1))", f"{T}/test_hj_sections.py"),
    ("theory/hj_on_qxr.py", "return P.D1 + p * P.D3[..., None]", "return P.D1 - p * P.D3[..., None]", f"{T}/test_hj_sections.py"),
    ("theory/hj_on_qxr.py", "gamma1(q1, s0 + P.L) - momentum_plus(P)", "gamma1(q1, s0) - momentum_plus(P)", f"{T}/test_hj_sections.py"),
    ("theory/legendrian.py", "torch.cat([tau[..., None] * p0, -p1", "torch.cat([p0, -p1", f"{T}/test_legendrian.py"),
    ("theory/noether.py", "+ chi0 - chi1", "- chi0 + chi1", f"{V}/test_contact_noether.py"),
    ("theory/generating.py", "D1 = G_q - (Y_q.mT", "D1 = G_q + (Y_q.mT", f"{V}/test_discrete_hamilton_jacobi.py"),
    ("theory/hamilton_jacobi.py", "return join(q1, p1, s1) - join(*prolongation(S1, q1))", "return join(q1, p1, s1) - join(*prolongation(S1, q))", f"{V}/test_discrete_hamilton_jacobi.py"),
    ("mechanics/regularity.py", "torch.minimum(*beside) / size", "size / torch.minimum(*beside)", f"{K}/test_explain.py"),
    ("theory/rotations.py", "0.5 * _sinc(0.25 * x) ** 2", "0.5 * _sinc(x) ** 2", f"{T}/test_rotations.py"),
    # scenes
    ("scenes/exact.py", "- (D23 * Y_s).sum(-1)", "", f"{S}/test_exact.py"),
    ("scenes/exact.py", "inverse - p0[..., :, None]", "inverse + p0[..., :, None]", f"{S}/test_exact.py"),
    ("scenes/exact.py", ".real > 0).all(-1)", ".real.prod(-1) > 0)", f"{S}/test_exact.py::test_beyond_a_conjugate_point_is_nan_with_a_reason"),
    ("scenes/galerkin.py", "[..., ends] - moved[..., :-1, :-1]", "[..., ends] + moved[..., :-1, :-1]", f"{S}/test_rules.py"),
    ("scenes/galerkin.py", "0.5 - 0.1 * ROOT5", "0.5 - 0.11 * ROOT5", f"{S}/test_rules.py::test_order_on_the_damped_pendulum"),
    ("scenes/rules.py", "L_d(q1, q0, s0 + x, -h)", "L_d(q1, q0, s0, -h)", f"{S}/test_rules.py"),
    ("scenes/rules.py", "h * L(q1, v, s0 + x)", "h * L(q1, v, s0)", f"{S}/test_rules.py"),
    ("scenes/parachute.py", "B**2 - 4 * (B - a) * p", "B**2 - 4 * (B + a) * p", f"{S}/test_closed_forms.py"),
    ("scenes/linear_drag.py", "h * expm1w(-gamma * h) / (2 * m)", "h * expm1w(gamma * h) / (2 * m)", f"{S}/test_drag.py"),
    ("scenes/path.py", "lagrangian(*path(t[..., 0]), s)", "lagrangian(*path(t[..., 0]), 0 * s)", f"{S}/test_path.py"),
    # models
    ("models/model.py", "(c - 1.0) * (s0 - h / 2 * t.V0)", "(c - 1.0) * s0", "tests/unit/models/test_ladder_orders.py::test_every_weight_gives_second_order"),
    ("models/model.py", "(t.g / 2).exp() * t.K", "t.K", "tests/unit/models/test_ladder_orders.py::test_every_weight_gives_second_order"),
    ("models/jet.py", "second = a * other._second + b * self._second", "second = a * other._second - b * self._second", "tests/contracts/test_model_contract.py::test_closed_forms_match_autograd"),
    ("models/action.py", "for j in reversed(order) if backward else order", "for j in order", "tests/unit/models"),
    ("models/friction.py", "before, after = (c * h / 2)[..., None]", "before, after = (h / 2)[..., None]", "tests/contracts/test_model_contract.py"),
    ("models/mass.py", "self.network(x) - at_zero", "self.network(x)", "tests/unit/models"),
    # stepping
    ("mechanics/newton.py", "return x - solve(J, F - F.detach())", "return x + solve(J, F - F.detach())", f"{M}/test_partials.py::test_step_derivative_is_the_derivative_of_the_step"),
    ("stepping/rollout.py", "sigma = step.state, sigma * step.c", "sigma = step.state, step.c", f"{T}/test_boundary_value.py::test_the_cauchy_problem"),
    ("theory/evolution.py", "split(x0 + 0.5 * delta)", "split(x0)", f"{T}/test_evolution.py::test_order_two_on_a_nonlinear_damped_problem"),
    ("theory/evolution.py", "mean = 0.5 * (H(x0) + H(x1))", "mean = H(x0)", f"{T}/test_evolution.py::test_H_shrinks_by_c_along_the_contact_field"),
    ("stepping/composition.py", "c * part.c", "part.c", f"{K}/test_composition.py"),
    ("theory/splitting.py", "p = c0[..., None] * p + half", "p = p + half", f"{K}/test_composition.py"),
    ("theory/rigid_body.py", "c[..., None] * (F.mT @ M", "(F.mT @ M", f"{T}/test_rigid_body.py"),
    ("theory/rigid_body.py", "g = (h * root)[..., None] * M", "g = h[..., None] * M", f"{T}/test_rigid_body.py"),
    ("theory/constrained.py", "(Dg0.mT @ x[..., n:, None])", "(Dg1.mT @ x[..., n:, None])", f"{T}/test_constrained.py"),
    ("theory/constrained.py", "p1 = self._projected(q1, momentum_plus(P), s1, self._rows(q1)[1])", "p1 = momentum_plus(P)", f"{T}/test_constrained.py"),
    ("theory/degenerate.py", "q, p, s = q1, momentum_plus(P), s + P.L", "q, p, s = q1, momentum_plus(P), s", f"{T}/test_degenerate.py"),
    ("stepping/explicit.py", "drag = self.friction * delta / 2", "drag = self.friction * delta", f"{K}/test_explicit.py"),
    ("stepping/events.py", "first = torch.minimum(first, tau) if", "first = tau if", f"{K}/test_events.py"),
    # theorem 3, triple, caustics, continuous equation, rows of verify
    ("theory/continuous_equation.py", 'X, _, _ = self._sum(State(q, p, s), 0.0, 1)', 'X, _, _ = self._sum(State(q, p, s), 0.5, 1)', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'return split(X[..., :-1] / self.h)', 'return split(X[..., :-1])', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'return (p * q_dot).sum(-1) - s_dot', 'return (p * q_dot).sum(-1) + s_dot', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'return self.field(q, self.momentum(q, v, s), s)[2]', 'return -self.field(q, self.momentum(q, v, s), s)[2]', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'x[..., -1].exp(), error', '1 + x[..., -1], error', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'now, log_c = step.state, log_c - step.c.log()', 'now, log_c = step.state, log_c + step.c.log()', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", '(y[..., n] + P.L - s1)[..., None]], -1)', '(y[..., n] - P.L - s1)[..., None]], -1)', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'slope + P.force.plus_1, by_s + P.force.plus_3', 'slope, by_s', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'whole = int(ratio)\n    return whole, ratio - whole', 'whole = int(ratio)\n    return whole, ratio', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'lost = ~(error <= self.tolerance)', 'lost = ~(error >= 0)', f"{T}/test_continuous_equation.py"),
    ("theory/continuous_equation.py", 'now, c = part.state, c * part.c', 'now, c = part.state, part.c', f"{T}/test_continuous_equation.py"),
    ("theory/check.py", 'H_plus = RightHamiltonian(L_d, q1)(q, at1.dS, at0.S, h)', 'H_plus = RightHamiltonian(L_d, q1)(q, at1.dS, at1.S, h)', f"{T}/test_check.py"),
    ("theory/check.py", 'H_minus = LeftHamiltonian(L_d, q)(at0.dS, q1, at1.S, h)', 'H_minus = LeftHamiltonian(L_d, q)(at0.dS, q1, at0.S, h)', f"{T}/test_check.py"),
    ("theory/check.py", 'hamilton_jacobi_residual(at1.S, at0.S, at1.dS, q1, H_plus)', 'hamilton_jacobi_residual(at1.S, at0.S, at0.dS, q1, H_plus)', f"{T}/test_check.py"),
    ("theory/check.py", 'left = left_hamilton_jacobi_residual(at1.S, at0.S, at0.dS, q, H_minus)', 'left = left_hamilton_jacobi_residual(at1.S, at0.S, at0.dS, q1, H_minus)', f"{T}/test_check.py"),
    ("theory/check.py", 'diagram = commutation_defect(lambda *_: (q1, p1, s1), S0, S1, q)', 'diagram = 0 * commutation_defect(lambda *_: (q1, p1, s1), S0, S1, q)', f"{T}/test_check.py"),
    ("theory/check.py", '(self.right, self.left, self.diagram) if x.isfinite().any())', '(self.right,) if x.isfinite().any())', f"{T}/test_check.py"),
    ("theory/check.py", 'if not bool(torch.isfinite(self.diagram).any()):\n            return False', 'if not bool(torch.isfinite(self.diagram).any()):\n            return True', f"{T}/test_check.py"),
    ("theory/check.py", 'if not float(spread[-1]) > OPEN', 'if not float(spread[0]) > OPEN', f"{T}/test_check.py"),
    ("theory/check.py", 'or len(q) <= q.shape[-1]', 'or len(q) < 1', f"{T}/test_check.py"),
    ("theory/check.py", '_worst(self.right) <= self.bound < _worst(self.diagram)', '_worst(self.left) <= self.bound < _worst(self.diagram)', f"{T}/test_check.py"),
    ("theory/tulczyjew.py", 'torch.cat([tau[..., None] * p0, q1, -tau[..., None]], -1), (p1 * q1)', 'torch.cat([tau[..., None] * p0, -q1, -tau[..., None]], -1), (p1 * q1)', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", '(p1 * q1).sum(-1) - s1\n\n\ndef left_leg(', '(p1 * q1).sum(-1) + s1\n\n\ndef left_leg(', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", 'torch.cat([-q0, -p1 / tau[..., None], 1 / tau[..., None]], -1)', 'torch.cat([-q0, -p1, 1 / tau[..., None]], -1)', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", 's0 - (p0 * q0).sum(-1)\n', 's0 + (p0 * q0).sum(-1)\n', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", 'tau = -minus_tau', 'tau = minus_tau', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", 'tau = 1 / inverse', 'tau = inverse', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", 'z - (p0 * minus_q0).sum(-1)', 'z + (p0 * minus_q0).sum(-1)', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", '_jet(right[0], H_plus, -s0, -1.0)', '_jet(right[0], H_plus, s0, 1.0)', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", '_jet(left[0], H_minus, end[2], 1.0)', '_jet(left[0], H_minus, s0, 1.0)', f"{T}/test_tulczyjew.py"),
    ("theory/tulczyjew.py", '- s0 - P.L, -P.D1, q1, -1 - P.D3)', '- s0 + P.L, -P.D1, q1, -1 - P.D3)', f"{T}/test_tulczyjew.py"),
    ("theory/caustics.py", 'slope = P.D22[..., 0, :, :] if point else start', 'slope = start', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'if k == 0 and point:', 'if k == 0:', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'bend = P.c[..., k, None, None] * slope', 'bend = slope', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'torch.where(regular, kinetic[..., k], first)', '0', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'crossed = torch.where(passed & (crossed < 0), k, crossed)', 'crossed = torch.where(passed, k, crossed)', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'J[..., k, :, :].mT @ torch.linalg', 'J[..., k, :, :] @ torch.linalg', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'return P.D11 + cross + cross.mT', 'return P.D11', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'torch.where(turned, 0, _negative(-symmetric))', '_negative(-symmetric)', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'slope = torch.where(regular[..., None, None], carried, slope)', 'slope = carried', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("theory/caustics.py", 'final = torch.where(regular, final, torch.stack(margins, -1).amin(-1))', 'pass', f"{T}/test_hopf_lax.py {T}/test_tulczyjew.py {T}/test_boundary_value.py"),
    ("verify/derivative.py", 'error = D.abs() * spread, (D - found).abs() * spread', 'error = D.abs() * spread, (D - D).abs() * spread', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", 'scaled.amax((0, -1))[:, None]', '1.0', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", 'COARSE = 0.01', 'COARSE = 1e9', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", 'NARROW = 0.1 ', 'NARROW = 10.0 ', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", 'columns + weight * (ahead - behind)', 'columns + weight * ahead', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", 'good = (step.status == Status.CONVERGED)', 'good = (step.status >= 0)', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", 'spread = torch.where(spread > 1e-3 * floor, spread, floor)', 'spread = torch.ones_like(spread)', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", 'torch.where(spread > 0, spread, 1.0)\n', 'torch.where(spread > 1, spread, 1.0)\n', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", '(columns / offset[:, None]).mT', '(columns / offset[:, None])', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/derivative.py", 'torch.diag(k * offset)', 'torch.diag(offset)', "tests/unit/verify/test_derivative_row.py tests/verification/test_null_models.py"),
    ("verify/dissipation.py", 'ratio = own / best if', 'ratio = best / own if', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'ratio, 1.0, ratio < 1,', 'ratio, 1.0, True,', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'FACTORS = (-1.0, 0.0, 0.5, 2.0)', 'FACTORS = (2.0,)', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'TOLD = 0.05', 'TOLD = 1e9', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'TOLD = 0.05', 'TOLD = -1.0', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'best = min(nulls.values())', 'best = max(nulls.values())', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'rate.mul_(factor)', 'rate.mul_(1.0)', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'model = deepcopy(model)', 'pass', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'if not math.isfinite(own) or not any(', 'if math.isfinite(own) or not any(', "tests/unit/verify/test_data_checks.py"),
    ("verify/dissipation.py", 'model=_scaled(run.model, factor)', 'model=run.model', "tests/unit/verify/test_data_checks.py"),
]  # fmt: skip
KILLER = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


def copy_of_sources(folder: Path) -> Path:
    """`src` and `tests` in a folder of their own, so that nothing here is touched."""
    for name in ("src", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def killer(tree: Path, mutant: tuple[str, str, str, str]) -> str | None:
    """The first test that fails on this mutant, or None if it survives."""
    name, old, new, tests = mutant
    path = tree / "src" / "herglotz" / name
    text = path.read_text(encoding="utf-8")
    if text.count(old) < 1:
        raise SystemExit(f"{name}: no line with {old!r}; the list of mutants is out of date")
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    try:
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider", *tests.split()]
        environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(command, cwd=tree, capture_output=True, text=True, env=environment, check=False)
    finally:
        path.write_text(text, encoding="utf-8")
    if done.returncode not in (0, 1, 2):
        raise SystemExit(f"{name}: pytest did not run ({done.stdout[-300:]}{done.stderr[-300:]})")
    found = KILLER.search(done.stdout)
    return found[1] if found else None


def main() -> int:
    """Run all mutants and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="mutants whose file name contains this")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="at the same time (default: cores)")
    arguments = parser.parse_args()
    chosen = [m for m in MUTANTS if arguments.only in m[0]]
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        trees: Queue[Path] = Queue()
        for k in range(arguments.workers):
            trees.put(copy_of_sources(Path(folder, str(k))))

        def attempt(mutant: tuple[str, str, str, str]) -> str | None:
            tree = trees.get()
            try:
                return killer(tree, mutant)
            finally:
                trees.put(tree)

        survivors = 0
        with ThreadPoolExecutor(arguments.workers) as pool:
            for (name, old, new, _), by in zip(chosen, pool.map(attempt, chosen), strict=True):
                survivors += by is None
                print(f"{'SURVIVED' if by is None else 'killed  '}  {name}: {old}  →  {new}", flush=True)
                if by is not None:
                    print(f"          by {by}", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} mutants killed")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
