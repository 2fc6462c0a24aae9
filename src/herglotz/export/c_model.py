"""The terms of a model as C: constants, potential, features, damping and correction."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from herglotz.errors import InputError
from herglotz.export.c_action import ACTION, ACTION_LEGENDRE_PLUS
from herglotz.export.c_equation import CONSTANT_MASS, EVALUATION, LEGENDRE_PLUS, POSITION_MASS, TYPES
from herglotz.export.c_features import check_terms, feature_lines
from herglotz.export.c_jet import JETS, KINETIC
from herglotz.export.c_network import network, weights
from herglotz.export.c_solver import LEAPFROG
from herglotz.export.c_template import number, numbers, render
from herglotz.models import ContactLagrangian
from herglotz.models.friction import Friction
from herglotz.models.jet import Jet
from herglotz.models.mass import PositionKinetic
from herglotz.models.network import Network
from herglotz.models.terms import AffineDamping, Kinetic

MAX_WIDE = 24  # beyond, registers of n x n matrices outgrow the half megabyte of stack that some threads have

_POTENTIAL = """
/* V(q) and V'(q). */
typedef struct {
  real value, slope[NAME_N];
} NAME_potential_t;

static inline void NAME_potential(const real q[NAME_N], NAME_potential_t *V) {
{%if baseline}
{%if potential_network}
  real x[NAME_FEATURES], dx[NAME_FEATURES], bend[NAME_FEATURES], value;
  int f;
{%else}
  real x[NAME_FEATURES], bend[NAME_FEATURES];
{%end}
  V->value = SPREAD(0.0);
  NAME_position_features(q, x, bend);
@BASELINE@
{%if potential_network}
  NAME_potential_network(x, &value, dx);
  V->value += NAME_energy * value;
  for (f = 0; f < NAME_FEATURES; f++) V->slope[NAME_owner[f]] += NAME_energy * dx[f] * bend[f];
{%end}
{%else}
  int i;
  (void)q;
  V->value = SPREAD(0.0);
  for (i = 0; i < NAME_N; i++) V->slope[i] = SPREAD(0.0);
{%end}
}
"""

_PHASE = """
{%if full}
/* A function of (q0, q1, s0): value, d/ds0, d0 = d/dq0 + p0 d/ds0, d1 = d/dq1, their sum `both` and, on demand, the
   derivatives of d0 along q1. */
{%else}
/* A function of (q0, q1): value, d/dq0, d/dq1, their sum `both` and, on demand, d2/dq0 dq1. */
{%end}
typedef struct {
  real value, {%if full}ds, {%end}d0[NAME_N], d1[NAME_N], both[NAME_N], d01[NAME_N][NAME_N];
} NAME_jet;

/* What a network of the midpoint and the velocity reads, with its derivatives along q1. */
typedef struct {
  real x[NAME_PHASE], bend[NAME_FEATURES], along[NAME_N][NAME_PHASE];
} NAME_phase;

static inline void NAME_phase_features(const real q0[NAME_N], const real move[NAME_N], real h, int order,
    NAME_phase *f) {
  real mean[NAME_N];
  int i, j, k;
  for (i = 0; i < NAME_N; i++) {
    mean[i] = q0[i] + move[i] / R(2.0);
    f->x[NAME_FEATURES + i] = move[i] / (h * NAME_speed[i]);
  }
  NAME_position_features(mean, f->x, f->bend);
  for (j = 0; j < NAME_N; j++)  /* at either order: compilers warn of what they cannot follow */
    for (k = 0; k < NAME_PHASE; k++) f->along[j][k] = SPREAD(0.0);
  if (order < 2) return;
  for (j = 0; j < NAME_N; j++) {
    for (k = 0; k < NAME_FEATURES; k++)
      if (NAME_owner[k] == j) f->along[j][k] = f->bend[k] / R(2.0);
    f->along[j][NAME_FEATURES + j] = R(1.0) / (h * NAME_speed[j]);
  }
}

/* From derivatives along the features to those along q0 and q1. */
static inline void NAME_chain(const NAME_phase *f, real h, int order, const real dx[NAME_PHASE],
    real ddx[NAME_N][NAME_PHASE], NAME_jet *g) {
  int i, j, k;
{%if full}
  g->ds = SPREAD(0.0);
{%end}
  for (i = 0; i < NAME_N; i++) {
    real v = dx[NAME_FEATURES + i] / (h * NAME_speed[i]);
    g->d0[i] = -v;
    g->d1[i] = v;
    g->both[i] = SPREAD(0.0);
  }
  for (k = 0; k < NAME_FEATURES; k++) {
    real m = dx[k] * f->bend[k] / R(2.0);
    g->d0[NAME_owner[k]] += m;
    g->d1[NAME_owner[k]] += m;
    g->both[NAME_owner[k]] += R(2.0) * m;
  }
  if (order < 2) return;
  for (j = 0; j < NAME_N; j++) {
    for (i = 0; i < NAME_N; i++) g->d01[i][j] = -ddx[j][NAME_FEATURES + i] / (h * NAME_speed[i]);
    for (k = 0; k < NAME_FEATURES; k++) g->d01[NAME_owner[k]][j] += ddx[j][k] * f->bend[k] / R(2.0);
  }
  for (k = 0; k < NAME_FEATURES; k++)  /* sin'' = -sin, cos'' = -cos */
    g->d01[NAME_owner[k]][NAME_owner[k]] -= NAME_angle[k] * f->x[k] * dx[k] / R(4.0);
}
"""


def flags_of(model: ContactLagrangian) -> dict[str, bool]:
    """Which parts of the templates a model needs."""
    check_terms(model)
    damping, friction = model.damping, model.friction
    affine, full = isinstance(damping, AffineDamping), model.action is not None
    damping_network = isinstance(damping, AffineDamping) and damping.network is not None
    return {
        "affine": affine and not full,
        "full": full,
        "mass": isinstance(model.kinetic, PositionKinetic),
        "jet_N": model.correction is not None and not full,
        "damping_network": damping_network,
        "correction": model.correction is not None,
        "phase": damping_network or model.correction is not None or full or not isinstance(model.kinetic, Kinetic),
        "baseline": model.config.baseline,
        "potential_network": model.config.baseline and model.potential.network is not None,
        "linear": model.linear_in_q1,
        "friction": friction is not None,
        "dry": friction is not None and friction.dry,
        "inputs": model.config.inputs > 0,
        "scalar": model.config.dof == 1,
        "wide": model.config.dof <= MAX_WIDE,
    }


def networks_of(model: ContactLagrangian) -> dict[str, Network]:
    """The networks of a model by their names in the header."""
    networks: dict[str, Network] = {}
    if model.config.baseline and model.potential.network is not None:
        networks["potential"] = model.potential.network
    if isinstance(model.damping, AffineDamping) and model.damping.network is not None:
        networks["damping"] = model.damping.network
    if model.correction is not None:
        networks["correction"] = model.correction.network
    if isinstance(model.kinetic, PositionKinetic):
        networks["mass"] = _of_phase(model.kinetic.network, model.dof)
    return networks


def activations_of(model: ContactLagrangian) -> set[str]:
    """Which activation functions the networks use."""
    return {net.activation for net in networks_of(model).values()}


def constants_source(model: ContactLagrangian, dtype: str) -> str:
    """Parameters and weights, as a template text."""
    parts = [weights(name, net, dtype) for name, net in networks_of(model).items()]
    return _constants(model, dtype) + "".join(parts)


def functions_source(model: ContactLagrangian, dtype: str, flags: dict[str, bool]) -> str:
    """The terms and the step equation, as a template text that `widen` can turn into one for several samples."""
    parts = [
        network(name, net, net.activation, tangents=name != "potential", several=name == "mass")
        for name, net in networks_of(model).items()
    ]
    jets = flags["full"] or flags["mass"]
    parts += [
        _position_features(model, dtype),
        render(_POTENTIAL, {"BASELINE": _baseline(model, dtype)}, flags),
        render(_PHASE, None, flags) if flags["phase"] else "",
        render(JETS + KINETIC, None, flags) if jets else "",
        render(TYPES, None, flags),
        render(ACTION if flags["full"] else EVALUATION, _names_of_K(flags), flags),
        render(LEAPFROG, None, flags),
    ]
    return "".join(parts)


def legendre_plus_source(flags: dict[str, bool]) -> str:
    """FL⁺ of a solved step, for one sample."""
    return render(ACTION_LEGENDRE_PLUS if flags["full"] else LEGENDRE_PLUS, _names_of_K(flags), flags)


def _constants(model: ContactLagrangian, dtype: str) -> str:
    """Sizes and the parameters outside the networks."""
    config, damping = model.config, model.damping
    owner = [i for i, angle in enumerate(config.angles) for _ in range(2 if angle else 1)]
    angle = [float(config.angles[i]) for i in owner]
    kinetic = model.kinetic if isinstance(model.kinetic, Kinetic) else model.kinetic.constant
    assert isinstance(kinetic, Kinetic)
    mass = kinetic.mass().detach().cpu().double()
    rate = 0.0 if damping is None else float(damping.rate)
    lines = [
        "",
        "/* Features of the position: sin q, cos q of an angle, q / scale of another coordinate. */",
        f"enum {{ NAME_FEATURES = {len(owner)}, NAME_PHASE = {len(owner) + config.dof} }};",
        f"static const int NAME_owner[NAME_FEATURES] = {{{', '.join(map(str, owner))}}};",
        f"static const real NAME_angle[NAME_FEATURES] = {{{numbers(angle, dtype)}}};",
        f"static const real NAME_speed[NAME_N] = {{{numbers(config.speed, dtype)}}};",
        f"static const real NAME_energy = {number(sum(v * v for v in config.speed), dtype)};",
        f"static const real NAME_rate = {number(rate, dtype)};",
        "/* The mass matrix (at q = 0) and its inverse, row by row. */",
        f"static const real NAME_mass[NAME_N * NAME_N] = {{{numbers(mass.reshape(-1).tolist(), dtype)}}};",
        "static const real NAME_inverse_mass[NAME_N * NAME_N] = "
        f"{{{numbers(_inverse(mass).reshape(-1).tolist(), dtype)}}};",
    ]
    vectors = {"drag": damping.drag} if isinstance(damping, AffineDamping) else {}
    if model.friction is not None:
        vectors |= _friction_constants(model.friction)
    if isinstance(model.kinetic, PositionKinetic):
        vectors |= _mass_constants(model.kinetic)
    if model.action is not None:
        lines.append(f"enum {{ NAME_UNITS = {len(model.action.rate)} }};  /* of the flow of s */")
        slope = model.action.log_slope.exp() / model.action.size
        vectors |= {"action_rate": model.action.rate, "action_slope": slope}
        vectors |= {"action_weight": model.action.weight, "action_bias": model.action.bias}
    for name, values in vectors.items():
        words = numbers(values.reshape(-1).tolist(), dtype)
        lines.append(f"static const real NAME_{name}[{values.numel()}] = {{{words}}};")
    return "\n".join(lines) + "\n"


def _names_of_K(flags: dict[str, bool]) -> dict[str, str]:
    return POSITION_MASS if flags["mass"] else CONSTANT_MASS


def _of_phase(net: Network, dof: int) -> Network:
    """A network of the position as one of position and velocity, which it does not look at."""
    net = copy.deepcopy(net)
    first = net.weights[0].detach()
    net.weights[0] = nn.Parameter(torch.cat([first, first.new_zeros(len(first), dof)], 1))
    return net


def _mass_constants(kinetic: PositionKinetic) -> dict[str, Tensor]:
    """The factor C̄ of the mass at q = 0, and what the network gives there."""
    return {
        "mass_factor": kinetic.constant.factor(),
        "mass_origin": kinetic.network(Jet(kinetic.origin[None], 0, 1)).value,
    }


def _inverse(mass: Tensor) -> Tensor:
    """The inverse of the mass matrix.

    Raises
    ------
    InputError
        If the mass is singular: then no step is defined (erratum E4).
    """
    inverse, info = torch.linalg.inv_ex(mass)
    if int(info) != 0 or not bool(torch.isfinite(inverse).all()):
        raise InputError(f"the mass matrix {mass.tolist()} is singular, so the model has no step; fit it again")
    return inverse


def _friction_constants(friction: Friction) -> dict[str, Tensor]:
    vectors: dict[str, Tensor] = {"viscous": friction.viscous}
    if friction.dry:
        vectors |= {"coulomb": friction.coulomb, "breakaway": friction.breakaway}
        smooth, stribeck = friction.widths
        vectors |= {"per_smooth": 1 / smooth, "per_stribeck": 1 / stribeck}
    if friction.inputs:
        vectors |= {"input_map": friction.input_map, "input_offset": friction.offset()}
    return vectors


def _position_features(model: ContactLagrangian, dtype: str) -> str:
    """x(q) and bend = dx/dq, coordinate by coordinate."""
    lines, f = [], 0
    for i, angle in enumerate(model.config.angles):
        if angle:
            lines += [f"x[{f}] = bend[{f + 1}] = SIN(q[{i}]);", f"x[{f + 1}] = bend[{f}] = COS(q[{i}]);"]
            lines += [f"bend[{f + 1}] = -bend[{f + 1}];"]
            f += 2
        else:
            scale = number(model.config.scale[i], dtype)
            lines += [f"x[{f}] = q[{i}] / {scale};", f"bend[{f}] = R(1.0) / {scale} + SPREAD(0.0);"]
            f += 1
    head = "static inline void NAME_position_features(const real q[NAME_N], real *x, real bend[NAME_FEATURES]) {\n"
    return "\n/* The features x of a position and their derivatives. */\n" + head + _indented(lines) + "}\n"


def _baseline(model: ContactLagrangian, dtype: str) -> str:
    """K (1 − cos q) + b sin q of angles, k q² / 2 + b q of the others."""
    lines, f = [], 0
    stiffness, tilt = (x.detach().cpu().double().tolist() for x in (model.potential.stiffness, model.potential.tilt))
    for i, angle in enumerate(model.config.angles):
        k, b = number(stiffness[i], dtype), number(tilt[i], dtype)
        if angle:
            lines.append(f"V->value += {k} * (R(1.0) - x[{f + 1}]) + {b} * x[{f}];")
            lines.append(f"V->slope[{i}] = {k} * x[{f}] + {b} * x[{f + 1}];")
        else:
            lines.append(f"V->value += ({k} * q[{i}] / R(2.0) + {b}) * q[{i}];")
            lines.append(f"V->slope[{i}] = {k} * q[{i}] + {b};")
        f += 2 if angle else 1
    if model.potential.features is not None:
        lines += feature_lines(model.potential.features, dtype)
    return _indented(lines).rstrip("\n")


def _indented(lines: list[str]) -> str:
    return "".join(f"  {line}\n" for line in lines)
