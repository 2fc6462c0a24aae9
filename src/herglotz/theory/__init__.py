"""The paper, one file for each subject of a section. Fitting and stepping need none of these files.

    Contact manifolds                  jacobi, legendrian
    Continuous dynamics                continuous, legendre_dual, function_germ, hj_on_q
    Discrete Lagrangian dynamics       action, boundary, caustics
    Discrete Hamiltonian dynamics      left, hamiltonian, hamilton_equations
    Discrete Hamilton–Jacobi theory    generating, hamilton_jacobi, hopf_lax, check
    The conclusions                    evolution, hj_on_qxr, degenerate, tulczyjew, explicit_time
    Beyond the paper                   noether, symmetries, constrained, rigid_body

`docs/paper.md` lists every equation of the paper with its function and its test.
"""

from herglotz.mechanics.scalar_fields import derivatives as derivatives
from herglotz.stepping.continuous_equation import (
    ContinuousEquation as ContinuousEquation,
    FractionalStepper as FractionalStepper,
    inverse_step as inverse_step,
)
from herglotz.theory.action import Action as Action, curve_action as curve_action, herglotz_action as herglotz_action
from herglotz.theory.boundary import Curve as Curve, boundary_value as boundary_value, initial_value as initial_value
from herglotz.theory.check import TheoremCheck as TheoremCheck, check as check
from herglotz.theory.constrained import ConstrainedStepper as ConstrainedStepper
from herglotz.theory.continuous import (
    contact_vector_field as contact_vector_field,
    evolution_vector_field as evolution_vector_field,
    herglotz_acceleration as herglotz_acceleration,
)
from herglotz.theory.degenerate import (
    LegendrianStepper as LegendrianStepper,
    legendrian_relation as legendrian_relation,
)
from herglotz.theory.evolution import EvolutionStepper as EvolutionStepper, midpoint_gradient as midpoint_gradient
from herglotz.theory.explicit_time import (
    TimeDependent as TimeDependent,
    energies as energies,
    time_defect as time_defect,
)
from herglotz.theory.function_germ import (
    Function as Function,
    FunctionGerm as FunctionGerm,
    germ as germ,
    prolongation as prolongation,
)
from herglotz.theory.generating import (
    GeneratingFunction as GeneratingFunction,
    generating_function as generating_function,
    generating_functions as generating_functions,
    hamilton_jacobi_residual as hamilton_jacobi_residual,
    left_generating_function as left_generating_function,
    left_hamilton_jacobi_residual as left_hamilton_jacobi_residual,
)
from herglotz.theory.hamilton_equations import (
    left_equations as left_equations,
    left_step as left_step,
    right_equations as right_equations,
    right_step as right_step,
)
from herglotz.theory.hamilton_jacobi import (
    PointSource as PointSource,
    Quadratic as Quadratic,
    commutation_defect as commutation_defect,
    projected_flow as projected_flow,
    projected_step as projected_step,
    riccati_step as riccati_step,
)
from herglotz.theory.hamiltonian import (
    LeftHamiltonian as LeftHamiltonian,
    RightHamiltonian as RightHamiltonian,
    right_hamiltonian_on_flow as right_hamiltonian_on_flow,
)
from herglotz.theory.hj_on_q import (
    energy_on_section as energy_on_section,
    projected_field as projected_field,
    relatedness_defect as relatedness_defect,
)
from herglotz.theory.hj_on_qxr import (
    discrete_section_residuals as discrete_section_residuals,
    section_asymmetry as section_asymmetry,
    section_hamilton_jacobi_residual as section_hamilton_jacobi_residual,
    section_relatedness_defect as section_relatedness_defect,
    transport_section as transport_section,
)
from herglotz.theory.hopf_lax import HopfLax as HopfLax, Propagated as Propagated, hopf_lax as hopf_lax
from herglotz.theory.jacobi import (
    bivector as bivector,
    contact_curvature as contact_curvature,
    differential as differential,
    divergence as divergence,
    flat as flat,
    jacobi_bracket as jacobi_bracket,
    lie_derivative_of_contact_form as lie_derivative_of_contact_form,
    reeb_field as reeb_field,
    sharp as sharp,
    sharp_bivector as sharp_bivector,
)
from herglotz.theory.left import LeftLagrangian as LeftLagrangian
from herglotz.theory.legendre_dual import (
    fiber_derivative as fiber_derivative,
    fiber_inverse as fiber_inverse,
    legendre_dual as legendre_dual,
)
from herglotz.theory.legendrian import (
    LegendrianDefect as LegendrianDefect,
    contact_complement as contact_complement,
    contact_product_point as contact_product_point,
    contact_product_states as contact_product_states,
    legendrian_defect as legendrian_defect,
    product_potential as product_potential,
)
from herglotz.theory.noether import (
    dissipation_defect as dissipation_defect,
    infinitesimal_generator as infinitesimal_generator,
    invariance_defect as invariance_defect,
    momentum_map as momentum_map,
    noether_defect as noether_defect,
)
from herglotz.theory.rigid_body import (
    BodyRollout as BodyRollout,
    BodyState as BodyState,
    RigidBodyStepper as RigidBodyStepper,
    cayley as cayley,
    hat as hat,
)
from herglotz.theory.symmetries import Symmetries as Symmetries, symmetries as symmetries
from herglotz.theory.tulczyjew import (
    TulczyjewTriple as TulczyjewTriple,
    left_leg as left_leg,
    left_leg_states as left_leg_states,
    right_leg as right_leg,
    right_leg_states as right_leg_states,
    tulczyjew_triple as tulczyjew_triple,
)
