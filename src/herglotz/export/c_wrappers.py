"""Interfaces around the C header: a source file for CasADi or acados, and an FMU for co-simulation (FMI 3.0 or 2.0).

An FMU is an archive of the header, the functions of the standard, a binary, and XML files of its variables.
"""

from __future__ import annotations

import hashlib
import io
import platform
import re
import tempfile
import warnings
import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as xml

from herglotz.codegen.c_compiler import SOURCE, compiler, portable_library
from herglotz.data.files import PathLike, sealed_text, sealed_zip, write_trusted
from herglotz.errors import InputError
from herglotz.export.c_header import MAX_DERIVATIVES, NAME, export_c, identifier, numbers, read_metadata, runtime
from herglotz.export.metadata import input_labels
from herglotz.models import ContactLagrangian

# The suffix of the header's own prefix: the header has a NAME_step, and CasADi calls another NAME_step.
INNER = "_c"


def export_casadi(model: ContactLagrangian, path: PathLike, *, name: str | None = None, **settings: Any) -> Path:
    """Write the step as one C file that `casadi.external` loads once it is compiled.

    The file has x₁ = NAME_step(x, u, h), x = (q, p, s) of 2n + 1 numbers, in the units of `export_c`; NAME_hold, a time
    h of the fewest equal steps that are no longer than the typical one; NAME_shoot, NAME_hold of all intervals of a
    horizon in one call, where the file is compiled with -DNAME_HORIZON=COUNT; and up to 8 coordinates their Jacobians.
    Without inputs no function has the argument u. A step without a solution is an error of CasADi. docs/control.md has
    an example. Arguments, results and errors are those of `export_c`, without parameters and extras; the name of the
    file should end in `.c`.
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
    Arguments are those of `export_casadi`; h is the shooting interval. Raise InputError as in `export_c`, and if the
    model has more than 8 coordinates: acados needs the Jacobian.
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


# The versions of FMI, with their names of the capabilities to give derivatives and to save states.
VERSIONS = {
    "3.0": (
        ("providesDirectionalDerivatives", "providesAdjointDerivatives"),
        ("canGetAndSetFMUState", "canSerializeFMUState"),
    ),
    "2.0": (("providesDirectionalDerivative",), ("canGetAndSetFMUstate", "canSerializeFMUstate")),
}
# The units that FMI knows; other units are only names.
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


class Variable(NamedTuple):
    """A variable of the FMU; its value reference is its place in the list of all variables (`runtime/fmu.c`).

    The causality is "independent", "input" or "output".
    """

    name: str
    causality: str
    unit: str
    start: float | None
    description: str


def variables(entries: Mapping[str, Any]) -> list[Variable]:
    """Time, the inputs, q, p and s, in the order of the value references in the C file."""
    n = entries["dof"]
    names = entries.get("names") or [f"q{i + 1}" for i in range(n)]
    units = entries.get("units") or [""] * n
    start = entries.get("start") or {"q": [0.0] * n, "p": [0.0] * n, "s": 0.0}
    found = [Variable("time", "independent", entries.get("time_unit", "s"), None, "time")]
    found += [
        Variable(f"u.{name}", "input", unit, zero, "input, held over a communication step")
        for (name, unit), zero in zip(input_labels(entries), entries["input_zero"], strict=True)
    ]
    found += [Variable(f"q.{names[i]}", "output", units[i], start["q"][i], "coordinate") for i in range(n)]
    found += [Variable(f"p.{names[i]}", "output", "", start["p"][i], "momentum, D2 L_d") for i in range(n)]
    return [*found, Variable("s", "output", "", start["s"], "action, in units of L_d")]


def model_description(entries: Mapping[str, Any], version: str, token: str, source: str) -> bytes:
    """The file `modelDescription.xml` of FMI 3.0 or 2.0."""
    new, listed = version == "3.0", variables(entries)
    root = xml.Element(
        "fmiModelDescription",
        fmiVersion=version,
        modelName=entries["name"],
        description="The motion of a learned contact Lagrangian, step by step",
        generationTool=f"herglotz {entries['herglotz_version']}",
        variableNamingConvention="flat",
    )
    root.set("instantiationToken" if new else "guid", token)
    derivatives, states = VERSIONS[version]
    capabilities = {"canHandleVariableCommunicationStepSize": True}
    capabilities |= dict.fromkeys(derivatives, entries["dof"] <= MAX_DERIVATIVES) | dict.fromkeys(states, True)
    simulation = xml.SubElement(root, "CoSimulation", modelIdentifier=entries["name"])
    for key, value in capabilities.items():
        simulation.set(key, str(value).lower())
    if not new:
        xml.SubElement(xml.SubElement(simulation, "SourceFiles"), "File", name=source)
    _units(root, listed)
    categories = xml.SubElement(root, "LogCategories")
    for name in ("logStatusWarning", "logStatusError"):
        xml.SubElement(categories, "Category", name=name)
    xml.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(entries["h"]))
    _variables(root, listed, new)
    return _written(root)


def build_description(name: str, source: str) -> bytes:
    """The file `buildDescription.xml` of FMI 3.0, for compiling the sources."""
    root = xml.Element("fmiBuildDescription", fmiVersion="3.0")
    build = xml.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    files = xml.SubElement(build, "SourceFileSet", language="C99")
    xml.SubElement(files, "SourceFile", name=source)
    xml.SubElement(build, "Library", name="m")
    return _written(root)


def _units(root: xml.Element, has: list[Variable]) -> None:
    units = dict.fromkeys(variable.unit for variable in has if variable.unit)
    if units:
        definitions = xml.SubElement(root, "UnitDefinitions")
        for name in units:
            unit = xml.SubElement(definitions, "Unit", name=name)
            if name in BASE_UNITS:
                xml.SubElement(unit, "BaseUnit", {name: "1"})


def _variables(root: xml.Element, has: list[Variable], new: bool) -> None:
    """The variables and the outputs of FMI 3.0 (`new`) or 2.0."""
    listed, structure = xml.SubElement(root, "ModelVariables"), xml.SubElement(root, "ModelStructure")
    outputs = structure if new else xml.SubElement(structure, "Outputs")
    for reference, variable in enumerate(has):
        is_output = variable.causality == "output"
        found = {"name": variable.name, "valueReference": str(reference), "causality": variable.causality}
        found |= {"variability": "continuous", "description": variable.description}
        # An output can be set before the first step.
        found |= {"initial": "exact"} if is_output else {}
        value = {"unit": variable.unit} if variable.unit else {}
        value |= {} if variable.start is None else {"start": repr(float(variable.start))}
        if new:
            xml.SubElement(listed, "Float64", found | value)
        else:
            xml.SubElement(xml.SubElement(listed, "ScalarVariable", found), "Real", value)
        if is_output:
            # FMI 2.0 counts variables from 1. Between steps an output depends on no input.
            place = {"valueReference": str(reference)} if new else {"index": str(reference + 1)}
            xml.SubElement(outputs, "Output" if new else "Unknown", place, dependencies="")


def _written(root: xml.Element) -> bytes:
    xml.indent(root)
    return xml.tostring(root, encoding="utf-8", xml_declaration=True)


# Names of operating systems and processors in Python → in the standard.
SYSTEM = {"Linux": "linux", "Darwin": "darwin", "Windows": "windows"}
MACHINE = {"AMD64": "x86_64", "arm64": "aarch64"}
FMI2_FOLDER = {"x86_64-linux": "linux64", "x86_64-darwin": "darwin64", "x86_64-windows": "win64"}
ENDING = {"linux": ".so", "darwin": ".dylib", "windows": ".dll"}
# Names that the two versions of the standard spell with other capital letters.
SPELLED = {
    "2.0": {"STATE": "FMUstate", "DESERIALIZE": "DeSerializeFMUstate"},
    "3.0": {"STATE": "FMUState", "DESERIALIZE": "DeserializeFMUState"},
}
# The date of every entry of the archive, so that the same model gives the same bytes.
EPOCH = (1980, 1, 1, 0, 0, 0)


def export_fmu(
    model: ContactLagrangian, path: PathLike, *, name: str | None = None, version: str = "3.0", **settings: Any
) -> Path:
    """Write the model as an FMU for co-simulation: inputs u, outputs q, p, s, C sources and a binary.

    A communication step is one step of the header, or the fewest equal steps that are not longer than those the model
    was fitted for. The binary is for this machine's operating system and kind of processor; without a C compiler the
    FMU holds the sources alone, and a warning says so. docs/control.md says what the FMU does with each call.

    Parameters
    ----------
    model, path, name, settings
        As in `export_casadi`; the name of the file should end in `.fmu`, and `name` is the model's identifier. The
        entries names, columns, start and time_unit of the metadata give the variables' names, starts and units.
    version
        Version of FMI, "3.0" or "2.0".

    Raise InputError as in `export_c`, and if the version is neither.
    """
    if version not in VERSIONS:
        raise InputError(f"version must be one of {', '.join(VERSIONS)} (of FMI), got {version!r}")
    path = Path(path)
    name = prefix(path, name)
    header = header_of(model, name, settings)
    entries = read_metadata(header, path)
    token = hashlib.sha256(header.encode()).hexdigest()[:32]
    source = _source(entries, version, token)
    file = f"fmi{version[0]}.c"
    content = {
        "modelDescription.xml": model_description(entries, version, token, file),
        f"sources/{name}.h": header.encode(),
        f"sources/{file}": source.encode(),
    }
    if version == "3.0":
        content["sources/buildDescription.xml"] = build_description(name, file)
    try:
        compiler()
    except InputError as error:
        warnings.warn(f"{path}: C sources without a binary: {error}", RuntimeWarning, stacklevel=2)
    else:
        content[_binary(name, version)] = portable_library({f"{name}.h": header, SOURCE: source})
    return write_trusted(path, sealed_zip(_zipped(content)))


export_fmu2 = partial(export_fmu, version="2.0")


def header_in(content: bytes, path: PathLike) -> str:
    """The C header in an FMU; raise InputError if the file has none."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for name in archive.namelist():
                if re.fullmatch(r"sources/\w+\.h", name):
                    return archive.read(name).decode("utf-8", "replace")
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise InputError(f"{path}: is not a readable FMU ({error}); export the model again") from None
    raise InputError(f"{path}: has no header that herglotz wrote; export the model again")


def _source(entries: Mapping[str, Any], version: str, token: str) -> str:
    """The C source file: the functions of the standard around the header."""
    # An array of C has at least one entry.
    inputs = numbers([*entries["input_zero"], 0.0], entries["dtype"])
    words = {"HEADER": f"{entries['name']}.h", "TOKEN": token, "INPUTS": inputs, "HOLD": runtime("hold.h")}
    words |= {"V": version[0]} | SPELLED[version]
    text = "".join(map(runtime, ("fmu.c", f"fmi{version[0]}.c", "fmi.c")))
    text = re.sub(r"@(\w+)@", lambda m: words[m[1]], text)
    return re.sub(r"\bhz_", f"{entries['name']}_", text)


def _binary(name: str, version: str) -> str:
    """The path of the binary for this machine in an FMU."""
    system = SYSTEM.get(platform.system(), platform.system().lower())
    folder = f"{MACHINE.get(platform.machine(), platform.machine())}-{system}"
    folder = FMI2_FOLDER.get(folder, folder) if version == "2.0" else folder
    return f"binaries/{folder}/{name}{ENDING.get(system, '.so')}"


def _zipped(content: Mapping[str, bytes]) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            entry = zipfile.ZipInfo(name, EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(entry, data)
    return made.getvalue()
