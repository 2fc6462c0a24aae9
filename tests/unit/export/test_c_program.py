"""The header in other programs: compilers, -ffast-math, batches, statuses, a motion at rest, docs/c.md."""

import functools
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from herglotz.errors import InputError
from herglotz.export import export_c, load_c
from herglotz.export.c_header import c_source, described
from herglotz.export.metadata import describe
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.terms import PositionKinetic
from tests.compilers import run_compiler
from tests.lagrangians import random_model

DOCS = Path(__file__).resolve().parents[3] / "docs" / "c.md"
COMPILERS = [c for c in ("gcc", "clang") if shutil.which(c)]
pytestmark = pytest.mark.skipif(not COMPILERS, reason="neither gcc nor clang in the PATH")
FAST = ("-O3", "-march=native", "-ffast-math")
BOX = {"q_low": [-9.0], "q_high": [9.0], "p_low": [-9.0], "p_high": [9.0], "s_low": [-99.0], "s_high": [99.0]}


def model(n=1, **options):
    sizes = (1.0,) * n
    config = ModelConfig((True,) * n, scale=sizes, speed=sizes, stiffness=sizes, tilt=(0.0,) * n, rate=0.3, **options)
    return random_model(config, spread=0.05, seed=2)


@functools.cache
def header(level="linear", n=1, box=False, **options):
    """A header for h from 0.05 to 0.2, without NAME_step_jacobian, which takes most of the time to trace."""
    made = model(n, level=level, **options)
    if isinstance(made.kinetic, PositionKinetic):  # so that it bends
        with torch.no_grad():
            made.kinetic.network.weights[-1].mul_(10)
    entries = describe(made, 0.1, {**BOX, "q_low": [-1.0], "q_high": [1.0]} if box else None, (), 30,
                       {"h_range": [0.05, 0.2]})  # fmt: skip
    return c_source(made, described(made, entries, "arm", "float64", None), "stepper.h", derivatives=False)


def run(tmp_path, code, compiler, *flags):
    """What a program prints, as words."""
    (tmp_path / "use.c").write_text(code)
    command = [compiler, "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", *flags, str(tmp_path / "use.c")]
    built = run_compiler([*command, "-o", str(tmp_path / "use"), "-lm"])
    assert built.returncode == 0, built.stderr[:2000]
    return subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout.split()


STATUSES = """
#include <stdio.h>
#include <stdlib.h>
#include "stepper.h"
int main(void) {
  const double nan = strtod("nan", 0), inf = strtod("inf", 0);  /* no compiler knows these values */
  arm_state x = {{0.1}, {0.2}, 0.0, 1.0}, y, many[3];
  double q[5], p[5], s[5], left;
  int statuses[3];
  printf("%d ", arm_step(&x, 0.1, &left));
  y = x;
  printf("%d %d %d %d ", arm_step(&y, 0.0, 0), arm_step(&y, -1.0, 0), arm_step(&y, nan, 0), arm_step(&y, inf, 0));
  y.q[0] = nan; printf("%d ", arm_step(&y, 0.1, 0));
  y = x; y.p[0] = inf; printf("%d ", arm_step(&y, 0.1, 0));
  y = x; y.s = nan; printf("%d ", arm_step(&y, 0.1, 0));
  y = x; y.sigma = nan; printf("%d ", arm_step(&y, 0.1, 0));
  y = x; y.p[0] = 1e308; printf("%d ", (arm_step(&y, 9.0, 0) & 15) != 0); printf("%d ", y.p[0] == 1e308);
  y = x; y.p[0] = 1e308; printf("%d ", (arm_rollout(&y, 9.0, 4, 1, q, p, s) & 15) != 0);
  printf("%d %d ", p[0] == 1e308, !arm_finite(q[1]) && !arm_finite(p[4]) && !arm_finite(s[4]));
  y = x; printf("%d ", arm_step(&y, 0.5, 0));
  y = x; y.q[0] += 2.0; printf("%d ", arm_step(&y, 0.1, 0));
  y = x; y.q[0] += 8 * atan(1.0); printf("%d ", arm_step(&y, 0.1, 0));
  y = x; printf("%d ", arm_rollout(&y, 0.1, 8, 2, q, p, s)); printf("%d %d ", q[0] == x.q[0], q[4] == y.q[0]);
  printf("%d %d ", arm_rollout(&x, 0.1, -1, 1, q, p, s), arm_rollout(&x, 0.1, 1, 0, q, p, s));
  many[0] = many[1] = many[2] = x; many[1].q[0] = nan;
  printf("%d ", arm_step_batch(3, many, 0.1, statuses));
  printf("%d %d %d\\n", statuses[0], statuses[1], statuses[2]);
  return 0;
}
"""


@pytest.mark.parametrize("flags", [("-O2",), FAST], ids=["O2", "fast-math"])
@pytest.mark.parametrize("compiler", COMPILERS)
def test_statuses_survive_fast_math(tmp_path, compiler, flags):
    # fails if bad input, overflow or the box goes unnoticed, an angle is not wrapped, a failed step moves the state, or
    # a check for NaN is a comparison, which -ffast-math deletes
    (tmp_path / "stepper.h").write_text(header(box=True, correction_width=4))
    words = run(tmp_path, STATUSES, compiler, *flags)
    assert " ".join(words) == "0 5 5 5 5 3 3 3 3 1 1 1 1 1 32 16 0 0 1 1 5 5 3 0 3 0"


INIT = """
#include <stdio.h>
#include <stdlib.h>
#include "stepper.h"
int main(void) {
  const double nan = strtod("nan", 0), inf = strtod("inf", 0);
  const double q0[1] = {0.1}, q1[1] = {0.12}, bad[1] = {nan};
  const double u[2] = {0.3, -0.2}, first[2] = {nan, 0.0}, last[2] = {0.0, inf};
  arm_state x = {{7.0}, {7.0}, 7.0, 7.0};
  printf("%d %d ", arm_init(bad, q1, 0.0, 0.1, u, &x), arm_init(q0, bad, 0.0, 0.1, u, &x));
  printf("%d %d ", arm_init(q0, q1, inf, 0.1, u, &x), arm_init(q0, q1, 0.0, 0.0, u, &x));
  printf("%d %d ", arm_init(q0, q1, 0.0, 0.1, first, &x), arm_init(q0, q1, 0.0, 0.1, last, &x));
  printf("%d ", x.q[0] == 7.0 && x.p[0] == 7.0 && x.s == 7.0 && x.sigma == 7.0);
  printf("%d %d\\n", arm_init(q0, q1, 0.0, 0.1, u, &x), arm_init(q0, q1, 0.0, 0.1, 0, &x));
  return 0;
}
"""


@pytest.mark.parametrize("flags", [("-O0",), ("-O1", "-ffast-math")], ids=["O0", "fast-math"])
def test_init_checks_all_it_is_given(tmp_path, flags):
    # fails if positions, s0, h or an input that is not finite start a motion, or a refused start writes to the state
    export_c(model(level="forced", inputs=2), tmp_path / "stepper.h", h=0.1, name="arm")
    assert " ".join(run(tmp_path, INIT, COMPILERS[0], *flags)) == "5 5 5 5 5 5 1 0 0"


ROLLOUT = """
#include <stdio.h>
#include "stepper.h"
enum { B = 21, K = 50 };
int main(void) {
  static arm_state single[B], many[B];
  static double q[B][K + 1][arm_N];
  double worst = 0.0, inside = 0.0;
  int b, i, k;
  for (b = 0; b < B; b++) {
    for (i = 0; i < arm_N; i++) {
      single[b].q[i] = 0.1 * b - 1.0 + 0.3 * i;
      single[b].p[i] = 0.5 - 0.05 * b;
    }
    single[b].s = 0.0;
    single[b].sigma = 1.0;
    many[b] = single[b];
  }
  printf("%d ", arm_rollout_batch(B, many, 0.1, K, 1, &q[0][0][0], 0, 0, 0));
  for (b = 0; b < B; b++) {
    printf("%d ", arm_rollout(&single[b], 0.1, K, 1, 0, 0, 0));
    for (i = 0; i < arm_N; i++) {
      worst = fmax(worst, fabs(single[b].q[i] - many[b].q[i]));
      worst = fmax(worst, fabs(single[b].p[i] - many[b].p[i]));
      inside = fmax(inside, fabs(q[b][K][i] - many[b].q[i]));
    }
    worst = fmax(worst, fabs(single[b].sigma - many[b].sigma));
  }
  for (k = 0; k < 3; k++) printf("%.17g ", q[k][K][0]);
  printf("%g %g\\n", worst, inside);
  return 0;
}
"""


@pytest.mark.parametrize("compiler", COMPILERS)
def test_batches_and_fast_math_agree_with_single_samples(tmp_path, compiler):
    # fails if a lane is another sample's, the last partial register is dropped, or -ffast-math changes the result
    (tmp_path / "stepper.h").write_text(header("affine", 2, correction_width=3))
    plain, fast = (run(tmp_path, ROLLOUT, compiler, *flags) for flags in (("-O2",), FAST))
    for words in (plain, fast):
        assert words[:22] == ["0"] * 22
        assert float(words[-2]) <= 1e-12
        assert float(words[-1]) == 0.0
    assert max(abs(float(a) - float(b)) for a, b in zip(plain[22:25], fast[22:25], strict=True)) <= 1e-11


REST = """
#include <stdio.h>
#include <time.h>
#include "stepper.h"
static double run(arm_state *x, long steps) {
  clock_t begin = clock();
  if (arm_rollout(x, 0.1, steps, steps, 0, 0, 0) & 15) return -1.0;
  return (double)(clock() - begin);
}
int main(void) {
  arm_state x = {{0.1}, {0.0}, 0.0, 1.0}, y;
  double moving = 1e30, rest = 1e30;
  int k;
  for (k = 0; k < 5; k++) {
    double took;
    y.q[0] = 0.5; y.p[0] = 0.0; y.s = 0.0; y.sigma = 1.0;
    took = run(&y, 300);
    if (took < moving) moving = took;
  }
  if (run(&x, 4000) < 0.0) return 1;
  for (k = 0; k < 5; k++) {
    double took = run(&x, 300);
    if (took < rest) rest = took;
  }
  printf("%g %g %g %d\\n", moving, rest, x.q[0], x.sigma == 0.0);
  return 0;
}
"""


def test_a_motion_at_rest_is_not_slower(tmp_path):
    # fails if q, p or sigma linger among denormal numbers
    still = ContactLagrangian(ModelConfig((False,), rate=1.0, potential_width=0))
    export_c(still, tmp_path / "stepper.h", h=0.1, name="arm")
    code = REST.replace("300", "5000").replace("4000", "40000")
    moving, rest, q, gone = (float(x) for x in run(tmp_path, code, COMPILERS[0], "-O2"))
    assert q == 0.0
    assert gone == 1.0
    assert rest <= 3 * moving


JACOBIAN = """
#include <stdio.h>
#include "stepper.h"
int main(void) {
  arm_problem P;
  arm_terms at, up, down;
  double worst = 0.0, size = 0.0;
  int i, j;
  P.q0[0] = 0.3; P.q0[1] = -0.7; P.p0[0] = 0.4; P.p0[1] = 0.9; P.s0 = 0.8; P.h = 0.1;
  arm_potential(P.q0, &P.V0);
  arm_prepare(&P);
  arm_begin(&P, up.move);
  at.move[0] = 0.05;
  at.move[1] = -0.02;
  arm_evaluate(&P, &at);
  for (j = 0; j < 2; j++) {
    for (i = 0; i < 2; i++) up.move[i] = down.move[i] = at.move[i];
    up.move[j] += 1e-5;
    down.move[j] -= 1e-5;
    arm_evaluate_first(&P, &up);
    arm_evaluate_first(&P, &down);
    for (i = 0; i < 2; i++) {
      worst = fmax(worst, fabs((up.F[i] - down.F[i]) / 2e-5 - at.J[i * 2 + j]));
      size = fmax(size, fabs(at.J[i * 2 + j] + 10.0 * (i == j)));
    }
  }
  printf("%g %g\\n", worst, size);
  return 0;
}
"""


@pytest.mark.parametrize(
    ("level", "activation"), [("affine", "tanh"), ("affine", "softplus"), ("affine", "silu"), ("full", "tanh")]
)
def test_the_jacobian_is_the_derivative_of_the_equation(tmp_path, level, activation):
    # fails if a second derivative is wrong: Newton would still converge, only slower
    mass = 3 if level == "full" else 0
    text = header(level, 2, correction_width=6, activation=activation, mass_width=mass)
    (tmp_path / "stepper.h").write_text(text)
    worst, size = (float(x) for x in run(tmp_path, JACOBIAN, COMPILERS[0], "-O0"))
    assert worst <= 1e-8
    assert size >= 0.01  # the networks are seen beside the kinetic -m/h


def test_networks_vectorise(tmp_path):
    # fails if tanh or the products fall back to one number at a time: no wide multiply-add in the machine code
    if "x86" not in subprocess.run(["uname", "-m"], capture_output=True, text=True, check=True).stdout:
        pytest.skip("reads x86 machine code")
    if not shutil.which("objdump"):
        pytest.skip("no objdump")
    path = export_c(model(correction_width=16), tmp_path / "stepper.h", h=0.1, name="arm")
    (tmp_path / "use.c").write_text(
        f'#include "{path.name}"\nint f(arm_state *x) {{ return arm_rollout(x, 0.1, 9, 9, 0, 0, 0); }}\n'
    )
    for flags in (("-O3", "-mavx2", "-mfma"), ("-O3", "-mavx2", "-mfma", "-ffast-math")):
        command = [COMPILERS[0], "-std=c99", "-ffp-contract=fast", *flags, "-c", str(tmp_path / "use.c")]
        assert run_compiler([*command, "-o", str(tmp_path / "use.o")]).returncode == 0
        code = subprocess.run(["objdump", "-d", tmp_path / "use.o"], capture_output=True, text=True, check=True).stdout
        assert len(re.findall(r"vfn?m(?:add|sub)\d+pd.*%ymm", code)) > 40


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_program_of_the_docs(tmp_path, compiler):
    # fails if docs/c.md shows a program that does not compile or run with the file that its first line exports
    export_c(model(), tmp_path / "arm.h", h=0.1, box=BOX, units=["rad"])
    assert len(run(tmp_path, blocks("c")[0], compiler, "-O2")) == 300


def test_the_cmake_lines_of_the_docs(tmp_path):
    # fails if the snippet does not configure, build or link
    if not shutil.which("cmake") or not shutil.which("make"):
        pytest.skip("no cmake")
    export_c(model(), tmp_path / "arm.h", h=0.1)
    (tmp_path / "example.c").write_text(blocks("c")[0])
    (tmp_path / "CMakeLists.txt").write_text(blocks("cmake")[0])
    for command in (["cmake", "-S", ".", "-B", "build"], ["cmake", "--build", "build"]):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    done = subprocess.run([tmp_path / "build" / "example"], capture_output=True, text=True, check=True)
    assert len(done.stdout.splitlines()) == 100


TERMS = {
    "explicit": {"potential_width": 3},
    "viscous": {"level": "forced", "inputs": 1},
    "dry": {"level": "forced", "coulomb": True},
    "features": {"potential_width": 0, "features": ("cos(q1 - q2)", "sin(2q1)")},
    "affine": {"level": "affine", "damping_width": 3, "correction_width": 3, "activation": "softplus"},
    "full": {"level": "full", "action_width": 2, "mass_width": 3, "activation": "silu"},
    "lanes of large matrices": {"n": 17, "correction_width": 3},
    "too large for lanes": {"n": 25, "correction_width": 3},
}


@pytest.mark.slow
@pytest.mark.parametrize("terms", TERMS)
@pytest.mark.parametrize("flags", [("-O2",), FAST, ("-O2", "-Wshadow")], ids=["O2", "fast-math", "shadow"])
@pytest.mark.parametrize("language", [("-std=c99",), ("-x", "c++")], ids=["C", "C++"])
@pytest.mark.parametrize("compiler", COMPILERS)
def test_every_compiler_is_silent(tmp_path, compiler, language, flags, terms):
    # fails if a term's lines are no clean C99 or C++ to one of the compilers, or -ffast-math makes it warn
    settings = dict(TERMS[terms])
    made = model(settings.pop("n", 2), **settings)
    (tmp_path / "use.c").write_text('#include "stepper.h"\nint main(void) { return 0; }\n')
    for dtype in ("float64", "float32"):
        export_c(made, tmp_path / "stepper.h", h=0.1, dtype=dtype)
        command = [compiler, *language, "-Wall", "-Wextra", "-Wpedantic", "-Werror", *flags]
        done = subprocess.run(
            [*command, "-c", str(tmp_path / "use.c"), "-o", "/dev/null"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, (dtype, done.stderr[:2000])


def test_a_tolerance_is_what_newton_stops_at(tmp_path):
    # fails if `tolerance` is recorded and not used, or one that rounding cannot reach is taken
    made = model(correction_width=4)
    fine, loose = (export_c(made, tmp_path / f"{i}.h", h=0.1, tolerance=x) for i, x in enumerate((None, 1e-4)))
    x = torch.linspace(-1, 1, 5, dtype=torch.float64)
    runs = [load_c(path).rollout(x[:1], x[2:3], x[4], h=0.1, steps=40) for path in (fine, loose)]
    assert [load_c(path).metadata["newton_tolerance"] for path in (fine, loose)] == [16 * 2.0**-52, 1e-4]
    assert bool((runs[0].residual <= 1e-14).all())
    assert 1e-10 < float(runs[1].residual.max()) <= 1e-4 * float(runs[1].q.abs().max())
    assert 0 < float((runs[0].q - runs[1].q).abs().max()) < 1e-3
    for bad in (1e-16, 0.0, 1.0, float("nan")):
        with pytest.raises(InputError, match="tolerance must be"):
            export_c(made, tmp_path / "bad.h", h=0.1, tolerance=bad)
