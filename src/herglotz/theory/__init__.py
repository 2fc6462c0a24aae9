"""The paper, one file for each section or subject of one. Fitting and stepping need none of these files.

    Contact manifolds                  contact_manifolds
    Continuous dynamics                continuous
    Discrete Lagrangian dynamics       lagrangian_dynamics
    Discrete Hamiltonian dynamics      hamiltonian_dynamics
    Discrete Hamilton–Jacobi theory    hamilton_jacobi
    The conclusions                    evolution, hj_on_qxr, degenerate, explicit_time
    Beyond the paper                   noether, symmetries, constrained, rigid_body

`docs/paper.md` lists every equation of the paper with its function and its test.
"""

from herglotz.mechanics.partials import derivatives as derivatives
from herglotz.stepping.continuous_equation import (
    ContinuousEquation as ContinuousEquation,
    FractionalStepper as FractionalStepper,
    inverse_step as inverse_step,
)
from herglotz.theory.constrained import ConstrainedStepper as ConstrainedStepper
from herglotz.theory.contact_manifolds import (
    Function as Function,
    FunctionGerm as FunctionGerm,
    LegendrianDefect as LegendrianDefect,
    bivector as bivector,
    contact_complement as contact_complement,
    contact_curvature as contact_curvature,
    contact_product_point as contact_product_point,
    contact_product_states as contact_product_states,
    differential as differential,
    divergence as divergence,
    flat as flat,
    germ as germ,
    jacobi_bracket as jacobi_bracket,
    legendrian_defect as legendrian_defect,
    lie_derivative_of_contact_form as lie_derivative_of_contact_form,
    product_potential as product_potential,
    prolongation as prolongation,
    reeb_field as reeb_field,
    sharp as sharp,
    sharp_bivector as sharp_bivector,
)
from herglotz.theory.continuous import (
    contact_vector_field as contact_vector_field,
    energy_on_section as energy_on_section,
    evolution_vector_field as evolution_vector_field,
    fiber_derivative as fiber_derivative,
    fiber_inverse as fiber_inverse,
    herglotz_acceleration as herglotz_acceleration,
    legendre_dual as legendre_dual,
    projected_field as projected_field,
    relatedness_defect as relatedness_defect,
)
from herglotz.theory.degenerate import (
    LegendrianStepper as LegendrianStepper,
    TulczyjewTriple as TulczyjewTriple,
    left_leg as left_leg,
    left_leg_states as left_leg_states,
    legendrian_relation as legendrian_relation,
    right_leg as right_leg,
    right_leg_states as right_leg_states,
    tulczyjew_triple as tulczyjew_triple,
)
from herglotz.theory.evolution import EvolutionStepper as EvolutionStepper, midpoint_gradient as midpoint_gradient
from herglotz.theory.explicit_time import (
    TimeDependent as TimeDependent,
    energies as energies,
    time_defect as time_defect,
)
from herglotz.theory.hamilton_jacobi import (
    GeneratingFunction as GeneratingFunction,
    HopfLax as HopfLax,
    PointSource as PointSource,
    Propagated as Propagated,
    Quadratic as Quadratic,
    TheoremCheck as TheoremCheck,
    check as check,
    commutation_defect as commutation_defect,
    generating_function as generating_function,
    generating_functions as generating_functions,
    hamilton_jacobi_residual as hamilton_jacobi_residual,
    hopf_lax as hopf_lax,
    left_generating_function as left_generating_function,
    left_hamilton_jacobi_residual as left_hamilton_jacobi_residual,
    projected_flow as projected_flow,
    projected_step as projected_step,
    riccati_step as riccati_step,
)
from herglotz.theory.hamiltonian_dynamics import (
    LeftHamiltonian as LeftHamiltonian,
    LeftLagrangian as LeftLagrangian,
    RightHamiltonian as RightHamiltonian,
    left_equations as left_equations,
    left_step as left_step,
    right_equations as right_equations,
    right_hamiltonian_on_flow as right_hamiltonian_on_flow,
    right_step as right_step,
)
from herglotz.theory.hj_on_qxr import (
    discrete_section_residuals as discrete_section_residuals,
    section_asymmetry as section_asymmetry,
    section_hamilton_jacobi_residual as section_hamilton_jacobi_residual,
    section_relatedness_defect as section_relatedness_defect,
    transport_section as transport_section,
)
from herglotz.theory.lagrangian_dynamics import (
    Action as Action,
    Curve as Curve,
    boundary_value as boundary_value,
    curve_action as curve_action,
    herglotz_action as herglotz_action,
    initial_value as initial_value,
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
