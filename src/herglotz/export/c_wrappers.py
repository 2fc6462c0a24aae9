"""A C source file for CasADi or acados: the header, and the functions that CasADi or acados calls."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

from herglotz.data.files import PathLike, sealed_text, write_trusted
from herglotz.errors import InputError
from herglotz.export.c_header import MAX_DERIVATIVES, NAME, export_c, identifier, runtime
from herglotz.models import ContactLagrangian

# The suffix of the header's own prefix: the header has a NAME_step, and CasADi calls another NAME_step.
INNER = "_c"


def export_casadi(model: ContactLagrangian, path: PathLike, *, name: str | None = None, **settings: Any) -> Path:
    """Write the step as one C file that `casadi.external` loads once it is compiled.

    The file has x₁ = NAME_step(x, u, h), x = (q, p, s) of 2n + 1 numbers, in the units of `export_c`; NAME_hold, a time
    h of the fewest equal steps that are no longer than the typical one; NAME_shoot, NAME_hold of all intervals of a
    horizon in one call, where the file is compiled with -DNAME_HORIZON=COUNT; and up to 8 coordinates their Jacobians.
    Without inputs no function has the argument u. A step without a solution is an error of CasADi. docs/control.md has
    an example.

    Parameters
    ----------
    model, path, name, settings
        As in `export_c`, without parameters and extras; the name of the file should end in `.c`. Results and errors
        are those of `export_c`.
    """
    one, held = "1.0", "hz_steps_of(h, (double)hz_h)"
    step, hold, shoot = (
        runtime("casadi_function.c").replace("NAME_FN", f"NAME_{function}").replace("FN_STEPS(h)", steps)
        .replace("FN_COUNT", count)
        for function, steps, count in (("step", one, "1"), ("hold", held, "1"), ("shoot", held, "NAME_HORIZON"))
    )  # fmt: skip
    parts = (runtime("hold.h"), runtime("casadi.c"), step, hold, "\n#ifdef NAME_HORIZON", shoot, "#endif\n")
    return _wrapped(model, Path(path), name, "".join(parts), settings)


def export_acados(model: ContactLagrangian, path: PathLike, *, name: str | None = None, **settings: Any) -> Path:
    """Write the step as the C file that acados takes for discrete dynamics (`dyn_generic_source`).

    The file has NAME_disc_fun and NAME_disc_fun_jac: one step of h, x = (q, p, s). docs/control.md has an example.

    Parameters
    ----------
    model, path, name, settings
        As in `export_casadi`; h is the shooting interval.

    Raise InputError as in `export_c`, and if the model has more than 8 coordinates: acados needs the Jacobian.
    """
    if (n := model.config.dof) > MAX_DERIVATIVES:
        raise InputError(
            f"acados needs the Jacobian of a step, which C has up to {MAX_DERIVATIVES} coordinates, not {n}"
        )
    return _wrapped(model, Path(path), name, runtime("acados.c"), settings)


def header_of(model: ContactLagrangian, name: str, settings: dict[str, Any]) -> str:
    """The header that `export_c` writes."""
    with tempfile.TemporaryDirectory(prefix="herglotz-") as folder:
        return export_c(model, Path(folder, f"{name}.h"), name=name, **settings).read_text(encoding="utf-8")


def prefix(path: Path, name: str | None) -> str:
    """The given name, or the file's; raise InputError if the given name is no C identifier."""
    longest = 41 - len(INNER)
    name = identifier(path.stem)[:longest] if name is None else name
    if not re.fullmatch(NAME, name) or len(name) > longest:
        raise InputError(f"name must be a C identifier of at most {longest} letters, digits and _, got {name!r}")
    return name


def _wrapped(model: ContactLagrangian, path: Path, name: str | None, text: str, settings: dict[str, Any]) -> Path:
    name = prefix(path, name)
    inner = name + INNER
    around = (runtime("unread.h") + text).replace("NAME_", f"{name}_")
    around = re.sub(r"\bhz_", f"{inner}_", around)
    return write_trusted(path, sealed_text(header_of(model, inner, settings) + around).encode())
