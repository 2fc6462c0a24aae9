/* The step of one model, written by hand for `stepper.py`: L_d = (c - 1)(s0 - h/2 V0) + sqrt(c) K - h/2 (V0 + V1) + h E G
   with c = exp(-rate h), all coordinates angles, V = k (1 - cos q) + b sin q + E P(sin, cos), networks of width VW (one
   layer) and W (two layers). Plain loops, a cubic guess, Newton until the last move squared is below rounding, no status,
   no checks: what a careful programmer writes for one model and compiles with -O3 -march=native -ffast-math.

   weights.h defines N, VW, W, real, TANH, RATE, ENERGY and the arrays mass, stiffness, tilt, speed, vw, vb, vl (potential)
   and w0, b0, w1, b1, last (correction), all (outputs, inputs). */
#include <math.h>
#include "weights.h"

enum { F = 2 * N, M = 3 * N };

static void potential(const real q[N], real *V, real dV[N]) {
  real x[F], a[VW], g, dx[F];
  *V = 0;
  for (int i = 0; i < N; i++) {
    x[2 * i] = sin(q[i]);
    x[2 * i + 1] = cos(q[i]);
    *V += stiffness[i] * (1 - x[2 * i + 1]) + tilt[i] * x[2 * i];
    dV[i] = stiffness[i] * x[2 * i] + tilt[i] * x[2 * i + 1];
  }
  for (int k = 0; k < VW; k++) {
    real z = vb[k];
    for (int j = 0; j < F; j++) z += vw[k * F + j] * x[j];
    a[k] = z;
  }
  for (int k = 0; k < VW; k++) a[k] = TANH(a[k]);
  for (int j = 0; j < F; j++) dx[j] = 0;
  for (int k = 0; k < VW; k++) {
    *V += ENERGY * vl[k] * a[k];
    g = vl[k] * (1 - a[k] * a[k]);
    for (int j = 0; j < F; j++) dx[j] += g * vw[k * F + j];
  }
  for (int i = 0; i < N; i++) dV[i] += ENERGY * (dx[2 * i] * x[2 * i + 1] - dx[2 * i + 1] * x[2 * i]);
}

/* N = h E G at q1 = q0 + d: value, derivatives by q0 and q1 and, where H is given, the mixed second ones. */
static real correction(const real q0[N], const real d[N], real h, real d0[N], real d1[N], real H[N][N]) {
  real x[M], a[W], b[W], u[W], g[W], t[W], ta[W], tb[W], tu[W], dx[M], along[M], ddx[M], value = 0;
  for (int i = 0; i < N; i++) {
    x[2 * i] = sin(q0[i] + d[i] / 2);
    x[2 * i + 1] = cos(q0[i] + d[i] / 2);
    x[F + i] = d[i] / (h * speed[i]);
  }
  for (int k = 0; k < W; k++) {
    real z = b0[k];
    for (int j = 0; j < M; j++) z += w0[k * M + j] * x[j];
    a[k] = z;
  }
  for (int k = 0; k < W; k++) a[k] = TANH(a[k]);
  for (int k = 0; k < W; k++) {
    real z = b1[k];
    for (int j = 0; j < W; j++) z += w1[k * W + j] * a[j];
    b[k] = z;
  }
  for (int k = 0; k < W; k++) b[k] = TANH(b[k]);
  for (int k = 0; k < W; k++) {
    value += last[k] * b[k];
    g[k] = last[k] * (1 - b[k] * b[k]);
  }
  for (int j = 0; j < W; j++) u[j] = 0;
  for (int k = 0; k < W; k++)
    for (int j = 0; j < W; j++) u[j] += g[k] * w1[k * W + j];
  for (int j = 0; j < M; j++) dx[j] = 0;
  for (int k = 0; k < W; k++)
    for (int j = 0; j < M; j++) dx[j] += u[k] * (1 - a[k] * a[k]) * w0[k * M + j];
  for (int i = 0; i < N; i++) {
    real m = (dx[2 * i] * x[2 * i + 1] - dx[2 * i + 1] * x[2 * i]) / 2, v = dx[F + i] / (h * speed[i]);
    d0[i] = h * ENERGY * (m - v);
    d1[i] = h * ENERGY * (m + v);
  }
  for (int c = 0; H && c < N; c++) {
    for (int j = 0; j < M; j++) along[j] = 0;
    along[2 * c] = x[2 * c + 1] / 2;
    along[2 * c + 1] = -x[2 * c] / 2;
    along[F + c] = 1 / (h * speed[c]);
    for (int k = 0; k < W; k++) {
      real z = 0;
      for (int j = 0; j < M; j++) z += w0[k * M + j] * along[j];
      ta[k] = (1 - a[k] * a[k]) * z;
    }
    for (int k = 0; k < W; k++) {
      real z = 0;
      for (int j = 0; j < W; j++) z += w1[k * W + j] * ta[j];
      tb[k] = -2 * b[k] * (1 - b[k] * b[k]) * z * last[k];
    }
    for (int j = 0; j < W; j++) tu[j] = 0;
    for (int k = 0; k < W; k++)
      for (int j = 0; j < W; j++) tu[j] += tb[k] * w1[k * W + j];
    for (int k = 0; k < W; k++) t[k] = tu[k] * (1 - a[k] * a[k]) - 2 * a[k] * ta[k] * u[k];
    for (int j = 0; j < M; j++) ddx[j] = 0;
    for (int k = 0; k < W; k++)
      for (int j = 0; j < M; j++) ddx[j] += t[k] * w0[k * M + j];
    for (int i = 0; i < N; i++) {
      real m = (ddx[2 * i] * x[2 * i + 1] - ddx[2 * i + 1] * x[2 * i]) / 2, v = ddx[F + i] / (h * speed[i]);
      if (i == c) m -= (dx[2 * i] * x[2 * i] + dx[2 * i + 1] * x[2 * i + 1]) / 4;
      H[i][c] = h * ENERGY * (m - v);
    }
  }
  return h * ENERGY * value;
}

static void solve(real A[N][N], real b[N]) {
  for (int k = 0; k < N; k++)
    for (int i = k + 1; i < N; i++) {
      real f = A[i][k] / A[k][k];
      for (int j = k; j < N; j++) A[i][j] -= f * A[k][j];
      b[i] -= f * b[k];
    }
  for (int i = N - 1; i >= 0; i--) {
    for (int j = i + 1; j < N; j++) b[i] -= A[i][j] * b[j];
    b[i] /= A[i][i];
  }
}

/* `steps` steps from (q, p, s); writes q of each step. */
void hand_rollout(long steps, real h, real *q, real *p, real *s, real *out) {
  const real c = exp(-RATE * h), root = exp(-RATE * h / 2);
  real V0, dV0[N], V1, dV1[N], move[N], old[3][N] = {{0}}, d0[N], d1[N], H[N][N], momentum[N], delta[N];
  potential(q, &V0, dV0);
  for (int i = 0; i < N; i++) move[i] = h * p[i];
  for (long k = 0; k < steps; k++) {
    real K = 0, G, size, scale = 0;
    if (k > 3)
      for (int i = 0; i < N; i++) move[i] = 3 * (old[0][i] - old[1][i]) + old[2][i];
    for (int i = 0; i < N; i++) scale = fmax(scale, fabs(q[i]));
    for (int round = 0; round < 20; round++) {
      correction(q, move, h, d0, d1, H);
      for (int i = 0; i < N; i++) {
        momentum[i] = 0;
        for (int j = 0; j < N; j++) {
          momentum[i] += mass[i * N + j] * move[j] / h;
          H[i][j] -= root * mass[i * N + j] / h;
        }
        delta[i] = -(c * (p[i] - h / 2 * dV0[i]) - root * momentum[i] + d0[i]);
      }
      solve(H, delta);
      size = 0;
      for (int i = 0; i < N; i++) {
        move[i] += delta[i];
        size = fmax(size, fabs(delta[i]));
      }
      if (size * size <= EPS * scale * scale) break;
    }
    G = correction(q, move, h, d0, d1, 0);
    for (int i = 0; i < N; i++) {
      old[2][i] = old[1][i];
      old[1][i] = old[0][i];
      old[0][i] = move[i];
      q[i] += move[i];
      momentum[i] = 0;
      for (int j = 0; j < N; j++) momentum[i] += mass[i * N + j] * move[j] / h;
      K += momentum[i] * move[i] / 2;
    }
    potential(q, &V1, dV1);
    for (int i = 0; i < N; i++) {
      p[i] = root * momentum[i] - h / 2 * dV1[i] + d1[i];
      out[k * N + i] = q[i];
      dV0[i] = dV1[i];
    }
    *s = c * *s + root * K - h / 2 * (c * V0 + V1) + G;
    V0 = V1;
  }
}
