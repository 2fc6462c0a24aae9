"""The C file for acados' discrete dynamics, compiled and checked without acados: `examples/acados/check.c`."""

import ast
import subprocess
from pathlib import Path

import pytest
import torch
from export_models import damped, model_of, with_terms

from herglotz.errors import InputError
from herglotz.export import export_acados, load_exported
from tests.compilers import CC, run_compiler

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "acados"
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
SANITIZED = ("-O0", "-fno-sanitize-recover=all", "-fsanitize=address,undefined")
MODELS = {"inputs": lambda: damped("forced", torch.float64, inputs=2), "none": lambda: with_terms("m(q), coupled")}


@pytest.mark.skipif(CC is None, reason="no C compiler in the PATH")
@pytest.mark.parametrize("name", MODELS)
def test_the_example_compiles_and_its_jacobian_is_that_of_its_step(name, tmp_path):
    # fails if rows of u and x are exchanged, the Jacobian is not transposed, or the file needs more of acados than said
    model = MODELS[name]()
    path = export_acados(model, tmp_path / "arm.c", h=0.1)
    words = [str(CC), "-std=c99", *WARNINGS, *SANITIZED, f"-I{EXAMPLE / 'stand_in'}", f'-DMODEL="{path}"', "-DNAME=arm"]
    words += [str(EXAMPLE / "check.c"), "-o", str(tmp_path / "check"), "-lm"]
    built = run_compiler(words)
    assert built.returncode == 0, built.stderr[:2000]
    done = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True)
    assert done.returncode == 0, done
    assert float(done.stdout) <= 1e-7  # of entries of about 1; measured 1e-10
    assert load_exported(path).dof == model.config.dof  # the header in it, which needs no acados


@pytest.mark.skipif(CC is None, reason="no C compiler in the PATH")
def test_a_step_that_does_not_exist_is_nan(tmp_path):
    # fails if acados, which ignores what a function returns, is left with the state before the step
    export_acados(MODELS["none"](), tmp_path / "arm.c", h=0.1)
    check = (EXAMPLE / "check.c").read_text().replace("ux[i] = 0.1 + 0.05 * i", "ux[i] = INFINITY")
    failed = 'evaluated(ux, x1, jac); printf("%g %g", x1[0], jac[4]); return 0;'
    check = check.replace("if (evaluated(ux, x1, jac)) return 1;", failed)
    (tmp_path / "check.c").write_text(check)
    words = [str(CC), "-std=c99", f"-I{EXAMPLE / 'stand_in'}", f'-DMODEL="{tmp_path / "arm.c"}"', "-DNAME=arm"]
    assert run_compiler([*words, str(tmp_path / "check.c"), "-o", str(tmp_path / "check"), "-lm"]).returncode == 0
    out = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True, check=True).stdout
    assert out.replace("-", "") == "nan nan"


def test_more_coordinates_than_derivatives_are_refused(tmp_path):
    # fails if acados gets a file without the Jacobian that it calls
    with pytest.raises(InputError, match="acados needs the Jacobian"):
        export_acados(model_of(9, "linear"), tmp_path / "many.c", h=0.1)


def test_the_script_for_acados_names_what_the_file_has(tmp_path):
    # fails if the script, which needs acados to run, names another function or no longer parses
    text = (EXAMPLE / "ocp.py").read_text(encoding="utf-8")
    ast.parse(text)
    written = export_acados(MODELS["none"](), tmp_path / "cart.c", h=0.1).read_text()
    for name in ("cart_disc_fun", "cart_disc_fun_jac"):
        assert f'"{name}"' in text
        assert f"int {name}(void **in, void **out, void *params)" in written
