"""The terms of a model as C: constants, potential, features, damping and correction."""

from __future__ import annotations

import torch

from herglotz.export.c_equation import EVALUATION
from herglotz.export.c_network import arithmetic, network
from herglotz.export.c_template import number, numbers, render
from herglotz.models import ContactLagrangian
from herglotz.models.terms import AffineDamping, LinearDamping

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
  V->value = R(0.0);
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
  V->value = R(0.0);
  for (i = 0; i < NAME_N; i++) V->slope[i] = R(0.0);
{%end}
}
"""

_PHASE = """
/* A function of (q0, q1): value, d/dq0, d/dq1 and, on demand, d2/dq0 dq1. */
typedef struct {
  real value, d0[NAME_N], d1[NAME_N], d01[NAME_N][NAME_N];
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
  if (order < 2) return;
  for (j = 0; j < NAME_N; j++) {
    for (k = 0; k < NAME_FEATURES; k++) f->along[j][k] = NAME_owner[k] == j ? f->bend[k] / R(2.0) : R(0.0);
    for (i = 0; i < NAME_N; i++) f->along[j][NAME_FEATURES + i] = i == j ? R(1.0) / (h * NAME_speed[i]) : R(0.0);
  }
}

/* From derivatives along the features to those along q0 and q1. */
static inline void NAME_chain(const NAME_phase *f, real h, int order, const real dx[NAME_PHASE],
    real ddx[NAME_N][NAME_PHASE], NAME_jet *g) {
  int i, j, k;
  for (i = 0; i < NAME_N; i++) {
    real v = dx[NAME_FEATURES + i] / (h * NAME_speed[i]);
    g->d0[i] = -v;
    g->d1[i] = v;
  }
  for (k = 0; k < NAME_FEATURES; k++) {
    real m = dx[k] * f->bend[k] / R(2.0);
    g->d0[NAME_owner[k]] += m;
    g->d1[NAME_owner[k]] += m;
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
    damping = model.damping
    affine = isinstance(damping, AffineDamping)
    damping_network = isinstance(damping, AffineDamping) and damping.network is not None
    return {
        "affine": affine,
        "damping_network": damping_network,
        "correction": model.correction is not None,
        "phase": damping_network or model.correction is not None,
        "baseline": model.config.baseline,
        "potential_network": model.config.baseline and model.potential.network is not None,
        "linear": model.linear_in_q1,
        "scalar": model.config.dof == 1,
    }


def terms_source(model: ContactLagrangian, dtype: str) -> str:
    """Weights and functions of a model, as a template text for `finish`."""
    flags, damping = flags_of(model), model.damping
    parts = [_constants(model, dtype), arithmetic(dtype) if flags["phase"] or flags["potential_network"] else ""]
    if model.config.baseline and model.potential.network is not None:
        parts.append(network("potential", model.potential.network, dtype, tangents=False))
    if isinstance(damping, AffineDamping) and damping.network is not None:
        parts.append(network("damping", damping.network, dtype, tangents=True))
    if model.correction is not None:
        parts.append(network("correction", model.correction.network, dtype, tangents=True))
    parts += [
        _position_features(model, dtype),
        render(_POTENTIAL, {"BASELINE": _baseline(model, dtype)}, flags),
        _PHASE if flags["phase"] else "",
        render(EVALUATION, None, flags),
    ]
    return "".join(parts)


def _constants(model: ContactLagrangian, dtype: str) -> str:
    """Sizes and the parameters outside the networks."""
    config, damping = model.config, model.damping
    owner = [i for i, angle in enumerate(config.angles) for _ in range(2 if angle else 1)]
    angle = [float(config.angles[i]) for i in owner]
    mass = model.kinetic.mass().detach().cpu().double()
    lines = [
        "",
        "/* Features of the position: sin q, cos q of an angle, q / scale of another coordinate. */",
        f"enum {{ NAME_FEATURES = {len(owner)}, NAME_PHASE = {len(owner) + config.dof} }};",
        f"static const int NAME_owner[NAME_FEATURES] = {{{', '.join(map(str, owner))}}};",
        f"static const real NAME_angle[NAME_FEATURES] = {{{numbers(angle, dtype)}}};",
        f"static const real NAME_speed[NAME_N] = {{{numbers(config.speed, dtype)}}};",
        f"static const real NAME_energy = {number(sum(v * v for v in config.speed), dtype)};",
        f"static const real NAME_rate = {number(float(damping.rate), dtype)};",
        "/* The mass matrix and its inverse, row by row. */",
        f"static const real NAME_mass[NAME_N * NAME_N] = {{{numbers(mass.reshape(-1).tolist(), dtype)}}};",
        "static const real NAME_inverse_mass[NAME_N * NAME_N] = "
        f"{{{numbers(torch.linalg.inv(mass).reshape(-1).tolist(), dtype)}}};",
    ]
    if not isinstance(damping, LinearDamping):
        lines.append(f"static const real NAME_drag[NAME_N] = {{{numbers(damping.drag.tolist(), dtype)}}};")
    return "\n".join(lines) + "\n"


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
            lines += [f"x[{f}] = q[{i}] / {scale};", f"bend[{f}] = R(1.0) / {scale};"]
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
    return _indented(lines).rstrip("\n")


def _indented(lines: list[str]) -> str:
    return "".join(f"  {line}\n" for line in lines)
