"""The generated header as a file: its runtime, its prefix, its size."""

import re
import subprocess
from importlib import resources
from typing import Any

import pytest

from herglotz.data import files
from herglotz.errors import InputError
from herglotz.export import export_c
from herglotz.export.c_header import RUNTIME
from herglotz.models import ContactLagrangian, ModelConfig
from tests.compilers import CC, needs_compiler, run_compiler

pytestmark = needs_compiler


def test_every_file_of_the_runtime_is_in_the_package():
    # fails if the C files are not installed with the package, or hold a name without the prefix that export replaces
    folder = resources.files("herglotz.export").joinpath("runtime")
    for name in (*RUNTIME, "library.c"):
        text = folder.joinpath(name).read_text(encoding="utf-8")
        assert text
        defined = re.findall(r"#define (\w+)", text)
        assert not [x for x in defined if not x.startswith("hz_") and name != "library.c"], name


TWO = """
#include <stdio.h>
#include "arm.h"
#include "leg.h"
int main(void) {
  arm_state x = {{0.3}, {0.1}, 0.0, 1.0};
  leg_state y = {{0.3f, 0.2f}, {0.1f, 0.0f}, 0.0f, 1.0f};
  printf("%d %d\\n", arm_rollout(&x, 0.1, 10, 10, 0, 0, 0), leg_rollout(&y, 0.1f, 10, 10, 0, 0, 0));
  return 0;
}
"""


def small(n=1, **options) -> ContactLagrangian:
    sizes: dict[str, Any] = {name: (1.0,) * n for name in ("scale", "speed", "stiffness", "tilt")}
    return ContactLagrangian(ModelConfig((True,) * n, **{"potential_width": 3, **sizes, **options}))


def built(tmp_path, code, *flags):
    (tmp_path / "use.c").write_text(code)
    command = [CC, "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", *flags, "use.c"]
    return run_compiler([*command, "-o", "use", "-lm"], tmp_path)


def test_another_process_of_the_same_user_knows_what_was_written(monkeypatch, tmp_path):
    # fails if the record of written files is lost with the process, or what stands in it is never looked up
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files.write_trusted(tmp_path / "a.h", b"mine")
    monkeypatch.setattr(files, "_written", set())  # as in another process
    files.check_trusted(b"mine", "a.h", trust_code=False)
    with pytest.raises(InputError, match=r"a\.h: opening it runs code that it holds"):
        files.check_trusted(b"other", "a.h", trust_code=False)


def test_two_headers_live_in_one_program(tmp_path):
    # fails if a name, a macro or the guard of a header is not its own: the prefix is the name of the file
    export_c(small(), tmp_path / "arm.h", h=0.1)
    export_c(small(2, level="affine"), tmp_path / "leg.h", h=0.1, dtype="float32")
    done = built(tmp_path, TWO, "-O1")
    assert done.returncode == 0, done.stderr[:2000]
    assert subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout.split() == ["0", "0"]


def test_two_models_of_one_prefix_are_refused(tmp_path):
    # fails if the second header is skipped in silence because the guard is set
    export_c(small(), tmp_path / "arm.h", h=0.1, name="arm")
    export_c(small(rate=0.3), tmp_path / "leg.h", h=0.1, name="arm")
    done = built(tmp_path, TWO)
    assert done.returncode != 0
    assert "two different models have the prefix arm_" in done.stderr


def test_order_4_stays_small(tmp_path):
    # fails if jets are unrolled number by number: measured 0.2 MB
    features = ("cos(q1 - q2) v1 v2", "cos(q1)", "sin(2q2)")
    model = small(2, level="linear", order=4, potential_width=0, features=features)
    path = export_c(model, tmp_path / "stepper.h", h=0.1, name="arm")
    assert path.stat().st_size <= 600_000
    (tmp_path / "use.c").write_text(
        '#include "stepper.h"\nint f(arm_state *x) { return arm_rollout_batch(9, x, 0.1, 9, 9, 0, 0, 0, 0); }\n'
    )
    limit = 'ulimit -t 20; exec "$@"'
    command = [CC, "-std=c99", "-O3", "-ffp-contract=fast", "-c", "use.c", "-o", "use.o"]
    done = subprocess.run(
        ["sh", "-c", limit, "sh", *command], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[:2000]


def test_many_coordinates_have_no_derivative_in_c(tmp_path):
    # fails if the elimination of a large Jacobian is written out: tens of thousands of lines
    path = export_c(small(9), tmp_path / "stepper.h", h=0.1, name="arm")
    text = path.read_text()
    assert "#define arm_DERIVATIVES 0" in text
    assert "arm_slopes(const" not in text
