"""The paper's objects, a file a subject. Learning and stepping a model need none of them."""

from herglotz.theory.action import Action, curve_action, herglotz_action
from herglotz.theory.boundary import Curve, boundary_value, initial_value
from herglotz.theory.check import TheoremCheck, check
from herglotz.theory.constrained import ConstrainedStepper
from herglotz.theory.continuous import contact_vector_field, derivatives, evolution_vector_field, herglotz_acceleration
from herglotz.theory.continuous_equation import ContinuousEquation, FractionalStepper, inverse_step
from herglotz.theory.degenerate import LegendrianStepper, legendrian_relation
from herglotz.theory.evolution import EvolutionStepper, midpoint_gradient
from herglotz.theory.explicit_time import TimeDependent, energies, time_defect
from herglotz.theory.function_germ import Function, FunctionGerm, germ, prolongation
from herglotz.theory.generating import (
    GeneratingFunction,
    generating_function,
    generating_functions,
    hamilton_jacobi_residual,
    left_generating_function,
    left_hamilton_jacobi_residual,
)
from herglotz.theory.hamilton_equations import left_equations, left_step, right_equations, right_step
from herglotz.theory.hamilton_jacobi import (
    PointSource,
    Quadratic,
    commutation_defect,
    projected_flow,
    projected_step,
    riccati_step,
)
from herglotz.theory.hamiltonian import (
    LeftHamiltonian,
    RightHamiltonian,
    left_hamiltonian,
    left_hamiltonian_on_flow,
    right_hamiltonian,
    right_hamiltonian_on_flow,
    solve_right_position,
)
from herglotz.theory.hj_on_q import energy_on_section, projected_field, relatedness_defect
from herglotz.theory.hj_on_qxr import (
    discrete_section_residuals,
    section_asymmetry,
    section_hamilton_jacobi_residual,
    section_relatedness_defect,
    transport_section,
)
from herglotz.theory.hopf_lax import HopfLax, Propagated, hopf_lax
from herglotz.theory.jacobi import (
    bivector,
    contact_curvature,
    differential,
    divergence,
    flat,
    jacobi_bracket,
    lie_derivative_of_contact_form,
    reeb_field,
    sharp,
    sharp_bivector,
)
from herglotz.theory.left import LeftLagrangian
from herglotz.theory.legendre_dual import fiber_derivative, fiber_inverse, legendre_dual
from herglotz.theory.legendrian import (
    LegendrianDefect,
    contact_complement,
    contact_product_point,
    contact_product_states,
    legendrian_defect,
    product_potential,
)
from herglotz.theory.noether import (
    dissipation_defect,
    infinitesimal_generator,
    invariance_defect,
    momentum_map,
    noether_defect,
)
from herglotz.theory.rigid_body import BodyRollout, BodyState, RigidBodyStepper
from herglotz.theory.rotations import cayley, hat
from herglotz.theory.splitting import ContactSplitting, linear_damping
from herglotz.theory.symmetries import Symmetries, symmetries
from herglotz.theory.tulczyjew import (
    TulczyjewTriple,
    left_leg,
    left_leg_states,
    right_leg,
    right_leg_states,
    tulczyjew_triple,
)

__all__ = [
    "Action",
    "BodyRollout",
    "BodyState",
    "ConstrainedStepper",
    "ContactSplitting",
    "ContinuousEquation",
    "Curve",
    "EvolutionStepper",
    "FractionalStepper",
    "Function",
    "FunctionGerm",
    "GeneratingFunction",
    "HopfLax",
    "LeftHamiltonian",
    "LeftLagrangian",
    "LegendrianDefect",
    "LegendrianStepper",
    "PointSource",
    "Propagated",
    "Quadratic",
    "RightHamiltonian",
    "RigidBodyStepper",
    "Symmetries",
    "TheoremCheck",
    "TimeDependent",
    "TulczyjewTriple",
    "bivector",
    "boundary_value",
    "cayley",
    "check",
    "commutation_defect",
    "contact_complement",
    "contact_curvature",
    "contact_product_point",
    "contact_product_states",
    "contact_vector_field",
    "curve_action",
    "derivatives",
    "differential",
    "discrete_section_residuals",
    "dissipation_defect",
    "divergence",
    "energies",
    "energy_on_section",
    "evolution_vector_field",
    "fiber_derivative",
    "fiber_inverse",
    "flat",
    "generating_function",
    "generating_functions",
    "germ",
    "hamilton_jacobi_residual",
    "hat",
    "herglotz_acceleration",
    "herglotz_action",
    "hopf_lax",
    "infinitesimal_generator",
    "initial_value",
    "invariance_defect",
    "inverse_step",
    "jacobi_bracket",
    "left_equations",
    "left_generating_function",
    "left_hamilton_jacobi_residual",
    "left_hamiltonian",
    "left_hamiltonian_on_flow",
    "left_leg",
    "left_leg_states",
    "left_step",
    "legendre_dual",
    "legendrian_defect",
    "legendrian_relation",
    "lie_derivative_of_contact_form",
    "linear_damping",
    "midpoint_gradient",
    "momentum_map",
    "noether_defect",
    "product_potential",
    "projected_field",
    "projected_flow",
    "projected_step",
    "prolongation",
    "reeb_field",
    "relatedness_defect",
    "riccati_step",
    "right_equations",
    "right_hamiltonian",
    "right_hamiltonian_on_flow",
    "right_leg",
    "right_leg_states",
    "right_step",
    "section_asymmetry",
    "section_hamilton_jacobi_residual",
    "section_relatedness_defect",
    "sharp",
    "sharp_bivector",
    "solve_right_position",
    "symmetries",
    "time_defect",
    "transport_section",
    "tulczyjew_triple",
]
