"""The XML files of an FMU: its variables and capabilities."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple
from xml.etree import ElementTree as xml

from herglotz.export.c_header import MAX_DERIVATIVES

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
    n, m = entries["dof"], entries["inputs"]
    names = entries.get("names") or [f"q{i + 1}" for i in range(n)]
    units = entries.get("units") or [""] * n
    inputs = [(name, unit) for name, role, unit in entries.get("columns") or () if role == "input"]
    inputs = inputs if len(inputs) == m else [(f"u{j + 1}", "") for j in range(m)]
    start = entries.get("start") or {"q": [0.0] * n, "p": [0.0] * n, "s": 0.0}
    found = [Variable("time", "independent", entries.get("time_unit", "s"), None, "time")]
    found += [
        Variable(f"u.{name}", "input", unit, zero, "input, held over a communication step")
        for (name, unit), zero in zip(inputs, entries["input_zero"], strict=True)
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
    (_fmi3 if new else _fmi2)(root, listed)
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


def _attributes(variable: Variable, reference: int) -> dict[str, str]:
    """Attributes of any version; an output can be set before the first step (`initial` is exact)."""
    found = {"name": variable.name, "valueReference": str(reference), "causality": variable.causality}
    found |= {"variability": "continuous", "description": variable.description}
    return found | ({"initial": "exact"} if variable.causality == "output" else {})


def _of_value(variable: Variable) -> dict[str, str]:
    found = {"unit": variable.unit} if variable.unit else {}
    return found | ({} if variable.start is None else {"start": repr(float(variable.start))})


def _fmi3(root: xml.Element, has: list[Variable]) -> None:
    listed, structure = xml.SubElement(root, "ModelVariables"), xml.SubElement(root, "ModelStructure")
    for reference, variable in enumerate(has):
        xml.SubElement(listed, "Float64", _attributes(variable, reference) | _of_value(variable))
        if variable.causality == "output":
            xml.SubElement(structure, "Output", valueReference=str(reference), dependencies="")


def _fmi2(root: xml.Element, has: list[Variable]) -> None:
    listed = xml.SubElement(root, "ModelVariables")
    outputs = xml.SubElement(xml.SubElement(root, "ModelStructure"), "Outputs")
    for reference, variable in enumerate(has):
        one = xml.SubElement(listed, "ScalarVariable", _attributes(variable, reference))
        xml.SubElement(one, "Real", _of_value(variable))
        if variable.causality == "output":
            # FMI 2.0 counts variables from 1. Between steps an output depends on no input.
            xml.SubElement(outputs, "Unknown", index=str(reference + 1), dependencies="")


def _written(root: xml.Element) -> bytes:
    xml.indent(root)
    return xml.tostring(root, encoding="utf-8", xml_declaration=True)
