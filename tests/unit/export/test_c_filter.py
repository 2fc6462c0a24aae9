"""The Kalman filter of a header: its twin in Python, its covariance and that of its velocity against their errors."""

import ctypes
import math
import re
import shutil
import subprocess
from dataclasses import replace
from statistics import NormalDist
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_c_parameters import COMPILER, WARNINGS, address

import herglotz as hz
from herglotz.codegen.c_compiler import build
from herglotz.data import Trajectories
from herglotz.data.gaps import with_missing
from herglotz.errors import InputError
from herglotz.export import export_c, filtering, noise_of
from herglotz.export.filtering import _parts
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.numbers import values_of
from herglotz.stepping import State, Stepper
from herglotz.stepping.filter import KalmanFilter, Noise
from tests.compilers import run_compiler

pytestmark = pytest.mark.skipif(COMPILER is None, reason="neither gcc nor clang in the PATH")
H, NAMES = 0.05, ["friction.viscous[0]", "friction.viscous[1]"]
NOISE = Noise([0.01, 0.02], [0.2, 0.15], [0.01, 0.01])
LEARNED = NOISE._replace(adaptation=0.05)


class Fitted(SimpleNamespace):
    """What a run is to a filter; it counts how often it is asked for its steps."""

    asked = 0

    @property
    def h_range(self):
        self.asked += 1
        return H * (1 - 1e-7), H * (1 + 1e-7)


def run_of(model, data, sigma) -> Any:
    """A run with this noise of readings."""
    config = SimpleNamespace(frequencies=())
    return Fitted(
        model=model, metrics={"sigma": sigma}, data=data, h=H, arrival=data.arrival, config=config, reading={}
    )


def flat(noise):
    return [*noise.position, *noise.momentum, *noise.theta, noise.adaptation]


# Moves a motion with random forces and noise of the sensors, given as standard normal numbers, and follows it.
LOOPS = """
#include "stepper.h"
enum { STRIDE = 2 * arm_N + arm_P };
int follow(long runs, long steps, double h, const double *std, const double *noises, const double *start,
           const double *normal, double *error, double *covariance, double *speed, double *spread, double *y_out,
           double *v_true) {
  arm_noise noise;
  long b, k;
  int i, j, status = 0;
  for (i = 0; i < arm_N; i++) {
    noise.position[i] = noises[i];
    noise.momentum[i] = noises[arm_N + i];
  }
  for (i = 0; i < arm_P; i++) noise.theta[i] = noises[2 * arm_N + i];
  noise.adaptation = noises[2 * arm_N + arm_P];
  for (b = 0; b < runs; b++) {
    arm_filter filter;
    arm_state x = arm_start, guess = arm_start;
    arm_parameters theta = arm_defaults;
    for (i = 0; i < arm_N; i++) {
      guess.q[i] = start[i];
      guess.p[i] = start[arm_N + i];
      x.q[i] = guess.q[i] + std[i] * *normal++;
      x.p[i] = guess.p[i] + std[arm_N + i] * *normal++;
    }
    for (i = 0; i < arm_P; i++) theta.value[i] += std[STRIDE - arm_P + i] * *normal++;
    status |= arm_filter_start(&filter, &guess, 0, std);
    for (k = 0; k < steps; k++) {
      double y[arm_N], v[arm_N], surprise;
      arm_filter exact;
      for (i = 0; i < arm_N; i++) x.p[i] += noise.momentum[i] * sqrt(h / 2) * *normal++;
      for (i = 0; i < arm_P; i++) theta.value[i] += noise.theta[i] * sqrt(h) * *normal++;
      status |= arm_step(&x, h, &theta, 0);
      for (i = 0; i < arm_N; i++) {
        x.p[i] += noise.momentum[i] * sqrt(h / 2) * *normal++;
        y[i] = x.q[i] + noise.position[i] * *normal++;
        y_out[(b * steps + k) * arm_N + i] = y[i];
      }
      status |= arm_filter_predict(&filter, h, &noise);
      status |= arm_filter_update(&filter, y, &noise, &surprise);
      status |= arm_filter_velocity(&filter, h, v, spread + (b * steps + k) * arm_N * arm_N);
      exact.x = x;
      exact.theta = theta;
      for (i = 0; i < arm_F * arm_F; i++) exact.P[i / arm_F][i % arm_F] = 0.0;
      status |= arm_filter_velocity(&exact, h, v_true + (b * steps + k) * arm_N, 0);
      for (i = 0; i < arm_N; i++) {
        error[(b * steps + k) * STRIDE + i] = filter.x.q[i] - x.q[i];
        error[(b * steps + k) * STRIDE + arm_N + i] = filter.x.p[i] - x.p[i];
        speed[(b * steps + k) * arm_N + i] = v[i];
      }
      for (i = 0; i < arm_P; i++)
        error[(b * steps + k) * STRIDE + 2 * arm_N + i] = filter.theta.value[i] - theta.value[i];
      for (i = 0; i < arm_F; i++)
        for (j = 0; j < arm_F; j++) covariance[((b * steps + k) * arm_F + i) * arm_F + j] = filter.P[i][j];
    }
  }
  return status & 15;
}
/* Smooths y, of which every third row is no sample, and tells the estimates, covariances and velocities of all lags. */
int smooth(long steps, double h, const double *std, const double *noises, const double *start, const double *y, int lag,
           double *found, double *covariance, double *speed, double *surprise) {
  arm_past past[8];
  arm_smoother smoother;
  arm_filter filter;
  arm_noise noise;
  arm_state x = arm_start;
  long k;
  int i, j, back, status;
  for (i = 0; i < arm_N; i++) {
    noise.position[i] = noises[i];
    noise.momentum[i] = noises[arm_N + i];
    x.q[i] = start[i];
    x.p[i] = start[arm_N + i];
  }
  for (i = 0; i < arm_P; i++) noise.theta[i] = noises[2 * arm_N + i];
  noise.adaptation = noises[2 * arm_N + arm_P];
  status = arm_filter_start(&filter, &x, 0, std) | arm_smoother_start(&smoother, &filter, past, lag);
  for (k = 0; k < steps; k++) {
    status |= arm_smoother_predict(&smoother, h, &noise);
    if (k % 3 != 2) status |= arm_smoother_update(&smoother, y + k * arm_N, &noise, surprise++);
  }
  for (back = 0; back <= lag; back++) {
    const arm_filter *at = arm_smoothed(&smoother, back);
    if (!at) return -1;
    for (i = 0; i < arm_N; i++) {
      *found++ = at->x.q[i];
      found[arm_N - 1] = at->x.p[i];
    }
    found += arm_N;
    for (i = 0; i < arm_P; i++) *found++ = at->theta.value[i];
    for (i = 0; i < arm_F; i++)
      for (j = 0; j < arm_F; j++) *covariance++ = at->P[i][j];
    status |= arm_filter_velocity(at, h, speed, 0);
    speed += arm_N;
  }
  return (status & 15) | (arm_smoothed(&smoother, lag + 1) != 0 || arm_smoothed(&smoother, -1) != 0) << 5;
}
"""


def library_of(model, folder, dtype="float64"):
    path = folder / "stepper.h"
    export_c(model, path, h=H, name="arm", parameters=NAMES, extras=["filter"], dtype=dtype)
    return build(path.read_text(), LOOPS.replace("double", "arm_real"))


@pytest.fixture(scope="module")
def library(double_pendulum, tmp_path_factory):
    return library_of(double_pendulum, tmp_path_factory.mktemp("filter"))


@pytest.fixture(scope="module")
def double_pendulum():
    """Two links with viscous hinges; p and v differ by the mass matrix, and positions move by radians."""
    ones = (1.0, 1.0)
    config = ModelConfig(
        (True, True), "forced", ones, (3.0, 3.0), (9.0, 5.0), (0.0, 0.0), rate=0.0, potential_width=0,
        features=("cos(q1 - q2) v1 v2",),
    )  # fmt: skip
    model = ContactLagrangian(config)
    with torch.no_grad():
        model.get_parameter("kinetic.sum.coefficient").fill_(0.5)
        model.friction.viscous.copy_(torch.tensor([0.3, 0.2]))  # pyright: ignore[reportOptionalMemberAccess]
    return model


@pytest.fixture(scope="module")
def followed(library):
    """A function that simulates and follows: everything that `follow` writes."""

    def run(runs, steps, std, noise=NOISE, seed=0, true=1.0):
        """Its noise is `true` times what the filter is given."""
        n, K, F = 2, 2, 6
        make = torch.Generator().manual_seed(seed)
        normal = true * torch.randn(runs * (2 * n + K + steps * (3 * n + K)), generator=make, dtype=torch.float64)
        noises, start = (torch.tensor(x, dtype=torch.float64) for x in (flat(noise), [0.8, -0.5, 0, 0]))
        sizes = ((2 * n + K,), (F, F), (n,), (n, n), (n,), (n,))
        out = [torch.full((runs, steps, *size), torch.nan, dtype=torch.float64) for size in sizes]
        counts = (ctypes.c_long(runs), ctypes.c_long(steps), ctypes.c_double(H))
        assert library.follow(*counts, *map(address, (std, noises, start, normal, *out))) == 0
        return start, out

    return run


STD = torch.tensor([0.05, 0.05, 0.3, 0.3, 0.1, 0.1], dtype=torch.float64)


def test_it_is_its_twin_in_python(followed, double_pendulum):
    # fails if one of them has another gain, noise, order of q, p and θ, or forgets to carry θ's covariance along
    start, (error, covariance, speed, spread, y, _) = followed(1, 12, STD, LEARNED)
    kalman = KalmanFilter(double_pendulum, LEARNED, NAMES)
    belief = kalman.start(State(start[:2], start[2:], start.new_zeros(())), STD)
    for k in range(12):
        belief, _ = kalman.update(kalman.predict(belief, H), y[0, k])
        v, spread_v = kalman.velocity(belief, H)
        for ours, theirs in ((covariance, belief.covariance), (speed, v), (spread, spread_v)):
            assert (ours[0, k] - theirs).abs().max() <= 1e-10 * theirs.abs().max()
    assert error[0, -1].isfinite().all()
    assert kalman.names == NAMES
    assert (belief.theta - torch.tensor(values_of(double_pendulum, NAMES)).double()).abs().max() > 1e-4


def smoothed(library, start, y, lag):
    """What `smooth` writes, in the type of y."""
    real = ctypes.c_float if y.dtype == torch.float32 else ctypes.c_double
    steps, n, F = len(y), 2, 6
    noises = torch.tensor(flat(LEARNED), dtype=y.dtype)
    sizes = ((lag + 1, F), (lag + 1, F, F), (lag + 1, n), (steps,))
    outputs = [torch.full(size, torch.nan, dtype=y.dtype) for size in sizes]
    lists = [x.to(y.dtype) for x in (STD, noises, start, y)]
    counts = (ctypes.c_long(steps), real(H))
    assert library.smooth(*counts, *map(address, lists), ctypes.c_int(lag), *map(address, outputs)) == 0
    return outputs


def test_the_smoother_in_float(library, followed, double_pendulum, tmp_path):
    # fails if a number of the smoother is a double in a header of floats, or its covariance loses the digits of a float
    start, out = followed(1, 60, STD)
    y = out[4][0]
    single = smoothed(library_of(double_pendulum, tmp_path, "float32"), start, y.float(), 5)
    (found, covariance, *_), (found_low, covariance_low, *_) = smoothed(library, start, y, 5), single
    root = covariance.diagonal(dim1=1, dim2=2).sqrt()
    # In standard deviations: 3e-6 and 2e-6 off.
    assert ((found_low.double() - found).abs() / root).max() <= 1e-5
    assert ((covariance_low.double() - covariance).abs() / (root[:, :, None] * root[:, None])).max() <= 1e-5


def test_the_smoother_is_its_twin_in_python(library, followed, double_pendulum):
    # fails if the ring of C loses or swaps samples, a sample that is missing moves the lag, or the blocks that C keeps
    # are not those of the filter of a longer state, which the twin is
    start, out = followed(1, 17, STD)
    y, lag = out[4][0], 5
    found, covariance, speed, surprise = smoothed(library, start, y, lag)
    kalman = KalmanFilter(double_pendulum, LEARNED, NAMES)
    belief, surprises = kalman.start(State(start[:2], start[2:], start.new_zeros(())), STD), []
    for k in range(17):
        belief = kalman.predict(belief if k % 3 == 0 and k else kalman.remember(belief, lag), H)
        if k % 3 != 2:
            belief, own = kalman.update(belief, y[k])
            surprises.append(own)
    torch.testing.assert_close(surprise[: len(surprises)], surprise.new_tensor(surprises), rtol=1e-9, atol=0)
    for back in range(lag + 1):
        at = kalman.smoothed(belief, back)
        wanted = torch.cat([at.state.q, at.state.p, at.theta])
        torch.testing.assert_close(found[back], wanted, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(covariance[back], at.covariance, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(speed[back], kalman.velocity(at, H)[0], rtol=1e-10, atol=1e-10)
    for back in (-1, lag + 1):
        with pytest.raises(InputError, match="back must be 0 to 5"):
            kalman.smoothed(belief, back)


def test_its_covariance_is_that_of_its_errors(followed):
    # fails if the noise of forces is counted once instead of twice half, at another power of h, or P is not that of the
    # estimate: the mean over 200 runs of eᵀP⁻¹e (NEES), q, p and θ being 6 numbers, lies in its 95 % band
    runs, steps, F = 200, 100, 6
    _, (error, covariance, speed, spread, _, v) = followed(runs, steps, STD, seed=1)
    nees = (error * torch.linalg.solve(covariance, error)).sum(-1).mean(0)  # (steps,)
    inside = (nees - F).abs() <= NormalDist().inv_cdf(0.975) * (2 * F / runs) ** 0.5
    assert float(inside.double().mean()) >= 0.85  # times are correlated: 0.95 ± 0.04 over seeds
    assert abs(float(nees.mean()) - F) <= 0.5 * (2 * F / runs) ** 0.5 * NormalDist().inv_cdf(0.975)
    miss = speed - v
    own = (miss * torch.linalg.solve(spread, miss)).sum(-1).mean(0)
    assert abs(float(own.mean()) - 2) <= (4 / runs) ** 0.5 * NormalDist().inv_cdf(0.975)


def test_the_scale_of_the_noise_is_learned(followed):
    # fails if the scale is not learned, is that of deviations in place of variances, or moves an estimate: of noise
    # that is three times what the filter is given, NEES is 9 times too large, and after 75 updates as it should be
    _, (_, _, speed, spread, *_) = followed(40, 150, STD, seed=2, true=3.0)
    _, (_, _, same, learned, _, v) = followed(40, 150, STD, LEARNED, seed=2, true=3.0)
    assert torch.equal(speed, same)
    miss = (speed - v)[:, 75:]
    before, after = ((miss * torch.linalg.solve(x[:, 75:], miss)).sum(-1).mean() for x in (spread, learned))
    assert before > 16
    assert abs(after - 2) <= 0.3  # 0.16 here; of 40 runs the mean has a standard error of 0.1


PROGRAM = """
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "stepper.h"
int main(void) {
  const double nan = strtod("nan", 0), y[2] = {0.1, 0.2}, bad[2] = {0.1, nan};
  const double turned[2] = {0.1 + 6.283185307179586, 0.2};
  double std[arm_F] = {0.1, 0.1, 0.1, 0.1, 0.1}, v[2], left, surprise[2];
  arm_noise noise = {{0.01, 0.01}, {0.1, 0.1}, {0.0}, 0.0};
  arm_filter f, g;
  arm_past past[2], kept[2];
  arm_smoother s;
  int i;
  printf("%d ", arm_filter_start(&f, &arm_start, 0, std));
  g = f;
  printf("%d ", arm_filter_predict(&f, 0.1, &noise));
  printf("%d %d ", arm_filter_predict(&g, -0.1, &noise), arm_filter_update(&g, bad, &noise, &left));
  noise.position[1] = 0.0;
  printf("%d %d ", arm_filter_update(&g, y, &noise, 0), arm_filter_predict(&g, 0.1, &noise));
  printf("%d ", g.P[2][2] == std[2] * std[2] && g.x.q[1] == arm_start.q[1]);
  noise.position[1] = 0.01;
  std[1] = -1.0;
  printf("%d ", arm_filter_start(&g, &arm_start, 0, std));
  g = f;
  printf("%d %d ", arm_filter_update(&f, y, &noise, surprise), arm_filter_update(&g, turned, &noise, surprise + 1));
  printf("%d ", fabs(surprise[0] - surprise[1]) < 1e-9 && fabs(f.x.q[0] - g.x.q[0]) < 1e-12);
  printf("%d ", f.theta.value[0] >= arm_lowest.value[0] && f.theta.value[0] <= arm_highest.value[0]);
  printf("%d ", arm_filter_velocity(&f, 0.1, v, 0));
  printf("%d %d ", arm_smoother_start(&s, &f, past, 0), arm_smoother_start(&s, &f, 0, 2));
  g = f;
  g.P[1][0] = nan;
  printf("%d ", arm_smoother_start(&s, &g, past, 2));
  f.P[arm_F - 1][0] = f.P[0][arm_F - 1] = 0.05; /* theta leaves its bounds with what is measured */
  f.P[arm_F - 1][arm_F - 1] = 100.0;
  printf("%d ", arm_smoother_start(&s, &f, past, 2));
  printf("%d ", arm_smoothed(&s, 1) == 0);
  printf("%d ", arm_smoother_predict(&s, 0.1, &noise));
  printf("%d ", arm_smoother_update(&s, y, &noise, 0));
  for (i = 0; i < 2; i++) {
    const double value = (i ? &s.now : &past[0].then)->theta.value[0];
    printf("%d ", value == arm_lowest.value[0] || value == arm_highest.value[0]);
  }
  kept[0] = past[0];
  g = s.now;
  noise.momentum[0] = -1.0;
  printf("%d %d ", arm_smoother_predict(&s, 0.1, &noise), arm_smoother_update(&s, y, &noise, 0));
  noise.momentum[0] = 0.1;
  printf("%d %d ", arm_smoother_predict(&s, nan, &noise), arm_smoother_update(&s, bad, &noise, 0));
  printf("%d ", !memcmp(kept, past, sizeof *past) && !memcmp(&g, &s.now, sizeof g) && arm_smoothed(&s, 2) == 0);
  printf("%d\\n", arm_smoothed(&s, 1) == &past[0].then);
  return 0;
}
"""


def test_what_is_no_number_changes_nothing(double_pendulum, tmp_path):
    # fails if a NaN, noise that is none or a step that is none changes the filter; if an angle is not taken modulo a
    # turn; or the C is not clean under warnings and sanitizers, or calls more than libm
    export_c(double_pendulum, tmp_path / "stepper.h", h=H, name="arm", parameters={NAMES[0]: (0.29, 0.31)},
             extras=["filter"])  # fmt: skip
    (tmp_path / "use.c").write_text(PROGRAM)
    command = [str(COMPILER), "-std=c99", *WARNINGS, "-O0", "-fno-sanitize-recover=all", "-fsanitize=address,undefined"]
    built = run_compiler([*command, str(tmp_path / "use.c"), "-o", str(tmp_path / "use"), "-lm"])
    assert built.returncode == 0, built.stderr[:2000]
    words = subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout.split()
    assert " ".join(words) == "0 0 5 5 5 5 1 5 0 0 1 1 0 5 5 5 0 1 0 0 1 1 5 5 5 5 1 1"
    if not shutil.which("nm"):
        pytest.skip("no nm")
    library = '#include "stepper.h"\nint f(arm_filter *x, const double *y, const arm_noise *n, double *v);\n' + (
        "int g(arm_smoother *x, const double *y, const arm_noise *n);\n"
        "int f(arm_filter *x, const double *y, const arm_noise *n, double *v) { return arm_filter_predict(x, 0.1, n) | "
        "arm_filter_update(x, y, n, v) | arm_filter_velocity(x, 0.1, v, 0); }\n"
        "int g(arm_smoother *x, const double *y, const arm_noise *n) { return arm_smoother_predict(x, 0.1, n) | "
        "arm_smoother_update(x, y, n, 0); }\n"
    )
    (tmp_path / "f.c").write_text(library)
    compile_ = [str(COMPILER), "-std=c99", "-O2", "-c", str(tmp_path / "f.c"), "-o", str(tmp_path / "f.o")]
    assert run_compiler(compile_).returncode == 0
    names = subprocess.run(["nm", "-u", tmp_path / "f.o"], capture_output=True, text=True, check=True).stdout
    # memcpy and memset are what a compiler makes of assignments and loops.
    own = {"sin", "cos", "sincos", "exp", "expm1", "sqrt", "fabs", "floor", "memcpy", "memset", "memmove"}
    assert set(re.findall(r"U (\w+)", names)) <= own


def test_noise_that_is_none_is_refused(double_pendulum, tmp_path):
    # fails if the twin takes noise, deviations or readings that C refuses, or a header an extra that there is not
    for noise, said in (
        (NOISE._replace(position=[0.0, 0.1]), "position"),
        (NOISE._replace(theta=[0.1]), "theta needs 2"),
    ):
        with pytest.raises(InputError, match=said):
            KalmanFilter(double_pendulum, noise, NAMES)
    kalman = KalmanFilter(double_pendulum, NOISE, NAMES)
    rest = State(*(torch.zeros(size, dtype=torch.float64) for size in (2, 2, ())))
    with pytest.raises(InputError, match="6 finite"):
        kalman.start(rest, STD[:4])
    with pytest.raises(InputError, match="leave that sample out"):
        kalman.update(kalman.start(rest, STD), torch.tensor([0.0, torch.nan], dtype=torch.float64))
    with pytest.raises(InputError, match="extras may be"):
        export_c(double_pendulum, tmp_path / "x.h", h=H, extras=["smoother"])


def test_a_recording_is_followed_with_the_noise_of_the_fit():
    # fails if the noise of the fit is not that of the filter (its surprise is then not 1), a gap is one large step, a
    # recording's input or a number that is estimated is left out, or trajectories run into one another; or if the run
    # is asked for its steps again for every sample, which took most of the time
    config = ModelConfig((True,), "forced", (1.0,), (2.0,), (4.0,), (0.0,), rate=0.0, potential_width=0)
    model = ContactLagrangian(config)
    with torch.no_grad():
        model.friction.viscous.fill_(0.4)  # pyright: ignore[reportOptionalMemberAccess]
        start = torch.tensor([[1.0], [-0.6]], dtype=torch.float64)
        exact = Stepper(model).rollout(start, 0 * start, 0 * start[:, 0], h=H, steps=80).q
    noise = torch.randn(exact.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    kept = torch.cat([torch.arange(30), torch.arange(34, 81)])  # a gap of five steps
    t, y = (kept * H).double().repeat(2), (exact + 0.01 * noise)[:, kept].reshape(-1, 1)
    data = Trajectories.of(t, y, (len(kept),) * 2, names=("a",), units=("rad",), angles=(True,))
    run = run_of(model, data, 0.01)
    found = hz.filter(run, data, {"friction.viscous": (0.3, 0.0)})
    assert run.asked <= 5
    assert 0.7 <= float(found.surprise.nanmean()) <= 1.3
    assert found.surprise.isnan().nonzero()[:, 0].tolist() == [0, len(kept)]
    v = (exact[:, 2:] - exact[:, :-2]) / (2 * H)
    miss = found.v.reshape(2, -1)[:, -30:-1] - v[:, kept[-30:-1] - 1, 0]
    assert float(miss.square().mean().sqrt()) <= 0.01
    theta, std = found.theta[-1, 0], found.covariance[-1, -1, -1].sqrt()
    assert std < 0.1
    assert abs(float(theta) - 0.4) <= 3 * std
    # A filter finds its noise by itself, which takes most of the time.
    noise = noise_of(run)
    known = noise._replace(theta=[0.0])
    smooth = hz.filter(run, data, {"friction.viscous": (0.3, 0.0)}, known, lag=10)
    torch.testing.assert_close(smooth.surprise, found.surprise, rtol=1e-9, atol=1e-12, equal_nan=True)
    for end in (len(kept) - 1, 2 * len(kept) - 1):  # the last sample waits for none
        torch.testing.assert_close(smooth.covariance[end], found.covariance[end], rtol=1e-12, atol=0)
        assert bool((smooth.covariance[end - 10 : end, 0, 0] < found.covariance[end - 10 : end, 0, 0]).all())
    for first in (0, len(kept)):
        assert smooth.covariance[first, 0, 0] < 0.9 * found.covariance[first, 0, 0]
    begin = Trajectories.of(t[:14], y[:14], (14,), names=("a",), units=("rad",), angles=(True,))
    until = hz.filter(run, begin, {"friction.viscous": (0.3, 0.0)}, known, lag=10)  # 3 waits for 13, here and there
    for row in range(4):
        torch.testing.assert_close(until.state.q[row], smooth.state.q[row], rtol=1e-9, atol=1e-12)
    assert abs(float(until.state.q[5] - smooth.state.q[5])) > 1e-6
    truth = exact[:, kept].reshape(-1, 1)
    misses = [float((x.state.q - truth)[5:-5].square().mean().sqrt()) for x in (found, smooth)]
    assert misses[1] <= 0.8 * misses[0]
    for lag in (-1, len(kept), 1.5):
        with pytest.raises(InputError, match=f"lag must be a whole number from 0 to {len(kept) - 1}.*got {lag}"):
            hz.filter(run, data, lag=lag)  # pyright: ignore[reportArgumentType]
    for pair in (0.3, (0.3,), (-0.3, 0.0), (0.3, math.nan)):
        with pytest.raises(InputError, match=r"friction.viscous needs two finite numbers >= 0, .*got"):
            hz.filter(run, data, {"friction.viscous": pair})  # pyright: ignore[reportArgumentType]
    table = {"t[s]": t[: len(kept)], "a[rad]": y[: len(kept), 0]}  # anything that `fit` takes
    of_table, of_data = (hz.filter(run, x, noise=noise) for x in (table, data.select([0])))
    torch.testing.assert_close(of_table.state.q, of_data.state.q)


def test_the_start_takes_the_steps_of_the_model():
    # fails if the momentum of the start is that of one step where the model takes ten: innovations of a motion without
    # noise are then far above its rounding
    model = ContactLagrangian(ModelConfig((True,), "linear", (1.0,), (2.0,), (4.0,), (0.0,), 0.2, potential_width=0))
    start = torch.tensor([[1.0], [-0.6]], dtype=torch.float64)
    with torch.no_grad():
        y = Stepper(model).rollout(start, 0 * start, 0 * start[:, 0], h=H, steps=80).q[:, ::10].reshape(-1, 1)
    t = (10 * H * torch.arange(9, dtype=torch.float64)).repeat(2)
    data = Trajectories.of(t, y, (9, 9), names=("a",), units=("rad",), angles=(True,))
    found = hz.filter(run_of(model, data, 1e-4), data, noise=Noise([1e-4], [1e-4]))
    assert float(found.surprise.nan_to_num().max()) <= 1e-12


def test_the_noise_of_a_fit_is_that_of_its_recording():
    # fails if the levels are those that the fit assumed (a tenth of the noise of readings, and next to no forces), the
    # spread of the start is not that of the filter, or an input does not act
    config = ModelConfig((True,), "forced", (1.0,), (2.0,), (4.0,), (0.0,), rate=0.0, potential_width=0, inputs=1,
                         input_map=(1.0,))  # fmt: skip
    model, make = ContactLagrangian(config).requires_grad_(False), torch.Generator().manual_seed(0)
    stepper, u = Stepper(model), torch.randn(600, 1, generator=make, dtype=torch.float64)
    state = State(*(torch.zeros(size, dtype=torch.float64) for size in ((1, 1), (1, 1), (1,))))
    q = []
    for k in range(600):
        q.append(state.q[0])
        state = stepper.step(state, H, u=u[k : k + 1]).state
        state = state._replace(p=state.p + 0.3 * H**0.5 * torch.randn(1, 1, generator=make, dtype=torch.float64))
    y = torch.stack(q) + 0.02 * torch.randn(600, 1, generator=make, dtype=torch.float64)
    t = (torch.arange(600) * H).double()
    data = Trajectories.of(t, y, (600,), u=u, names=("a",), units=("rad",), angles=(True,))
    run = run_of(model, data, 0.002)
    found = noise_of(run)
    assert found.position[0] == pytest.approx(0.02, rel=0.2)
    assert found.momentum[0] == pytest.approx(0.3, rel=0.2)
    # fails if a recording without inputs ends in an AssertionError, or one with too many in words on a shape
    for wrong, said in ((None, "the model is driven by 1 input"), (u.repeat(1, 2), r"2 input\(s\) u are recorded")):
        with pytest.raises(InputError, match=said):
            hz.filter(run, replace(data, u=wrong), noise=found)
    with pytest.raises(InputError, match="filter takes a run, got str; load_run"):
        hz.filter("runs/arm", data)  # pyright: ignore[reportArgumentType]


def test_the_noise_of_a_fit_is_the_likelier_of_two_ends(monkeypatch):
    # fails if the descent starts at large forces alone: of a cart with a pendulum it then ends where noise of 1e-11 rad
    # and large forces explain readings of 0.001 rad
    config = ModelConfig((True,), "linear", (1.0,), (2.0,), (4.0,), (0.0,), 0.2, potential_width=0)
    t = (H * torch.arange(9)).double()
    data = Trajectories.of(t, t.sin()[:, None], (9,), names=("a",), units=("rad",), angles=(True,))
    ends = []

    def likelihood(_run):
        def cost(x):
            # The force x_1 has two ends: a likely one at e^-6, and one above, where every descent from above ends.
            ends.append(float(x[1]))
            return min(float((x[1] + 6) ** 2), float((x[1] - 2) ** 2) + 1)

        return cost

    monkeypatch.setattr(filtering, "_likelihood", likelihood)
    found = noise_of(run_of(ContactLagrangian(config), data, 1e-3))
    assert math.log(found.momentum[0]) == pytest.approx(-6, abs=0.1)
    assert max(ends) >= 2  # the large forces are tried, too


def test_the_steps_that_lead_to_each_sample():
    # fails if a gap is one step, its parts begin at another row, or an input is read where a part begins
    t = torch.tensor([0.0, 0.1, 0.4, 0.0, 0.1, 0.2], dtype=torch.float64)
    data = Trajectories.of(t, t[:, None], (3, 3), names=("a",), units=("m",), angles=(False,))
    parts, rows, places, h = _parts(data, 0.1)
    assert parts.tolist() == [0, 1, 3, 0, 1, 1]
    assert rows.tolist() == [0, 1, 1, 1, 3, 4]
    assert places.tolist() == pytest.approx([1 / 2, 1 / 6, 1 / 2, 5 / 6, 1 / 2, 1 / 2])
    assert h.tolist() == pytest.approx([0.1] * 6)


def test_positions_that_were_not_read_tell_nothing_of_the_noise(double_pendulum):
    # fails if positions that were interpolated over blank cells count as measured, which gave forces of 1.3 times
    # their size
    make, std = torch.Generator().manual_seed(0), torch.tensor(NOISE.momentum, dtype=torch.float64) * H**0.5
    stepper, q = Stepper(double_pendulum), []
    state = State(*(torch.full(size, 0.5, dtype=torch.float64) for size in ((8, 2), (8, 2), (8,))))
    for _ in range(100):
        q.append(state.q)
        with torch.no_grad():
            state = stepper.step(state, H).state
        state = state._replace(p=state.p + std * torch.randn(8, 2, generator=make, dtype=torch.float64))
    y = torch.stack(q, 1).reshape(-1, 2) + 0.01 * torch.randn(800, 2, generator=make, dtype=torch.float64)
    t = (torch.arange(100) * H).double().repeat(8)
    data = Trajectories.of(t, y, (100,) * 8, names=("a", "b"), units=("rad",) * 2, angles=(True, True))
    data = with_missing(data, torch.rand(800, 2, generator=make) > 0.25, str)
    found = noise_of(run_of(double_pendulum, data, 0.01))
    assert found.momentum == pytest.approx(NOISE.momentum, rel=0.15), found
