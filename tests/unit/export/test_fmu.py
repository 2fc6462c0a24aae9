"""FMUs: valid, stepped by FMPy as the header steps, restored, differentiated, and refusing what cannot be."""

import ctypes
import json
import struct
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from export_models import damped, model_of, with_terms

from herglotz.codegen import c_compiler
from herglotz.errors import InputError
from herglotz.export import export_fmu, load_exported
from tests.compilers import CC, needs_compiler, run_compiler

fmpy = pytest.importorskip("fmpy", reason="fmpy is not installed (extra: control)")
pytestmark = needs_compiler
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
VERSIONS = ("3.0", "2.0")
INPUTS, STATE = (1, 2), (3, 4, 5)  # value references of the driven model
H = 0.1
METADATA = {
    "names": ["angle of <A> & B"],
    "columns": [["t", "time", "s"], ["angle of <A> & B", "coordinate", "rad"], ["F", "input", "N"], ["G", "input", ""]],
    "start": {"q": [0.3], "p": [-0.2], "s": 0.1, "t": 5.0},
    "time_unit": "s",
}
ERROR = 3


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    """The driven model as an FMU of each version, as a file and unpacked."""
    folder = tmp_path_factory.mktemp("fmus")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        found = {}
        for version in VERSIONS:
            path = folder / f"arm{version[0]}.fmu"
            box = {f"{x}_{end}": [sign * 9.0] for x in "qps" for end, sign in (("low", -1), ("high", 1))}
            export_fmu(
                damped("forced", torch.float64, inputs=2), path, h=H, units=["rad"], box=box, h_range=(H / 2, H),
                name="arm", version=version, metadata=METADATA,
            )  # fmt: skip
            found[version] = path, Path(fmpy.extract(str(path), str(folder / version)))
        yield found


class Instance:
    """An instance by FMPy, version by version: calls return their status."""

    def __init__(self, folder, version, ready=True):
        from fmpy import fmi2, fmi3

        self.new, self.said = version == "3.0", []
        words = fmpy.read_model_description(str(folder))
        kind: Any = fmi3.FMU3Slave if self.new else fmi2.FMU2Slave
        token = words.instantiationToken if self.new else words.guid
        self.fmu = kind(guid=token, unzipDirectory=str(folder), modelIdentifier="arm", instanceName="one")
        log = lambda *a: self.said.append((a[-1], a[-2], a[-3]))  # noqa: E731
        if self.new:
            self.fmu.instantiate(logMessage=log)
        else:
            calls = fmi2.fmi2CallbackFunctions()
            calls.logger = fmi2.fmi2CallbackLoggerTYPE(log)
            calls.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmi2.calloc)
            calls.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmi2.free)
            self.fmu.instantiate(callbacks=calls)
        self.dll, self.one = self.fmu.dll, ctypes.c_void_p(self.fmu.component)
        if ready:
            self.initialize()

    def initialize(self):
        if not self.new:
            self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def call(self, name, *arguments):
        return getattr(self.dll, ("fmi3" if self.new else "fmi2") + name)(self.one, *arguments)

    def real(self, verb, references, values):
        """Status of setting or getting values, which are written into."""
        refs = (ctypes.c_uint * len(references))(*references)
        size = (ctypes.c_size_t(len(references)),)
        name = f"{verb}Float64" if self.new else f"{verb}Real"
        return self.call(name, refs, *size, values, *(size if self.new else ()))

    def set(self, references, values):
        return self.real("Set", references, (ctypes.c_double * len(values))(*values))

    def get(self, references):
        values = (ctypes.c_double * len(references))()
        assert self.real("Get", references, values) == 0
        return np.array(values)

    def step(self, time, h):
        if not self.new:
            return self.call("DoStep", ctypes.c_double(time), ctypes.c_double(h), ctypes.c_int(1))
        flags = [ctypes.byref(ctypes.c_bool()) for _ in range(3)]
        last = ctypes.byref(ctypes.c_double())
        return self.call("DoStep", ctypes.c_double(time), ctypes.c_double(h), ctypes.c_bool(True), *flags, last)

    def derivative(self, kind, unknowns, knowns, seed):
        args = []
        for references in (unknowns, knowns):
            args += [(ctypes.c_uint * len(references))(*references), ctypes.c_size_t(len(references))]
        count = len(knowns) if kind == "Adjoint" else len(unknowns)
        result, seeds = (ctypes.c_double * count)(), (ctypes.c_double * len(seed))(*seed)
        sizes = (ctypes.c_size_t(len(seed)), ctypes.c_size_t(count))
        rest = (seeds, sizes[0], result, sizes[1]) if self.new else (seeds, result)
        return self.call(f"Get{kind}Derivative", *args, *rest), np.array(result)

    def state(self):
        found = ctypes.c_void_p()
        assert self.call(self.states("Get"), ctypes.byref(found)) == 0
        return found

    def states(self, verb):
        return verb + ("FMUState" if self.new else "FMUstate")


@pytest.fixture(params=VERSIONS)
def arm(request, fmus):
    made = Instance(fmus[request.param][1], request.param)
    yield made
    made.fmu.freeInstance()


@pytest.mark.parametrize("version", VERSIONS)
def test_the_description_is_valid_and_names_the_variables(version, fmus):
    # fails if the XML breaks the schema or a rule of the standard, a name is not escaped, or units and starts are lost
    from fmpy.validation import validate_fmu

    path = fmus[version][0]
    assert validate_fmu(str(path)) == []
    words = fmpy.read_model_description(str(path))
    assert words.fmiVersion == version
    assert [v.name for v in words.modelVariables] == [
        "time", "u.F", "u.G", "q.angle of <A> & B", "p.angle of <A> & B", "s"
    ]  # fmt: skip
    assert [v.unit for v in words.modelVariables] == ["s", "N", None, "rad", None, None]
    assert [float(v.start) for v in words.modelVariables[3:]] == [0.3, -0.2, 0.1]
    assert float(words.defaultExperiment.stepSize) == H


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.usefixtures("optimised_c")
def test_ten_thousand_steps_are_those_of_the_header(version, fmus):
    # fails if inputs act a step late, the carried guess is started again wrongly, or states and references are mixed up
    path, folder = fmus[version]
    one = Instance(folder, version)
    steps, when = 10_000, H * np.arange(10_000)
    u = np.stack([np.sin(0.3 * when), 0.5 * np.cos(0.7 * when)], 1)
    ours = np.empty((steps + 1, 3))
    ours[0] = one.get(STATE)
    assert ours[0].tolist() == [0.3, -0.2, 0.1]
    for k in range(steps):
        assert one.set(INPUTS, u[k]) == 0
        assert one.step(when[k], H) in (0, 1)
        ours[k + 1] = one.get(STATE)
    assert one.get([0])[0] == pytest.approx(when[-1] + H)
    one.fmu.terminate()
    one.fmu.freeInstance()
    start = (torch.tensor(x, dtype=torch.float64) for x in ([[0.3]], [[-0.2]], [0.1]))
    header = load_exported(path).rollout(*start, h=H, steps=steps, inputs=torch.tensor(u)[None])
    theirs = torch.cat([header.q[0], header.p[0], header.s[0, :, None]], 1).numpy()
    assert (abs(ours - theirs).max(0) <= 1e-12 * abs(theirs).max(0)).all()


@pytest.mark.parametrize("version", VERSIONS)
def test_fmpy_simulates_it(version, fmus):
    # fails if FMPy cannot run the file as it runs others: inputs of a table, starts that are set, outputs
    table = np.array([(0.0, 0.5, 0.0), (0.3, -0.5, 0.1)], dtype=[("time", float), ("u.F", float), ("u.G", float)])
    result = fmpy.simulate_fmu(
        str(fmus[version][0]), stop_time=1.0, step_size=H, output_interval=H, input=table,
        start_values={"q.angle of <A> & B": 0.0, "p.angle of <A> & B": 0.4}, output=["q.angle of <A> & B", "s"],
    )  # fmt: skip
    assert len(result) == 11
    assert result["q.angle of <A> & B"][0] == 0.0
    assert result["q.angle of <A> & B"][1] > 0.01


def test_states_are_saved_restored_and_written(arm):
    # fails if the carried guess, the time or the inputs of a state are lost, or bytes of something else are taken
    for k in range(5):
        arm.set(INPUTS, (0.3, 0.1))
        assert arm.step(k * H, H) == 0
    saved, q = arm.state(), arm.get(STATE)[0]

    def on():
        for k in range(5, 25):
            assert arm.step(k * H, H) == 0
        return arm.get((0, *INPUTS, *STATE))

    first = on()
    size = ctypes.c_size_t()
    assert arm.call("SerializedFMU" + ("State" if arm.new else "state") + "Size", saved, ctypes.byref(size)) == 0
    written = ((ctypes.c_ubyte if arm.new else ctypes.c_char) * size.value)()
    assert arm.call(arm.states("Serialize"), saved, written, size) == 0
    assert arm.call(arm.states("Set"), saved) == 0
    assert arm.get([0])[0] == pytest.approx(5 * H)
    assert on().tolist() == first.tolist()
    assert arm.call(arm.states("Free"), ctypes.byref(saved)) == 0
    assert not saved.value
    other, read = ctypes.c_void_p(), arm.states("Deserialize" if arm.new else "DeSerialize")
    assert arm.call(read, written, size, ctypes.byref(other)) == 0
    assert arm.call(arm.states("Set"), other) == 0
    assert on().tolist() == first.tolist()
    arm.call(arm.states("Free"), ctypes.byref(other))
    at = bytes(written).index(struct.pack("d", q))  # fails if bytes that hold no state are restored
    broken = type(written)(*(bytes(written)[:at] + struct.pack("d", float("nan")) + bytes(written)[at + 8 :]))
    assert arm.call(read, broken, size, ctypes.byref(other)) == ERROR
    written[3] = 63 if arm.new else b"?"  # no hexadecimal digit
    assert arm.call(read, written, size, ctypes.byref(other)) == ERROR
    assert arm.call(read, written, ctypes.c_size_t(size.value - 1), ctypes.byref(other)) == ERROR
    assert arm.call(arm.states("Set"), None) == ERROR


@pytest.mark.parametrize("h", [H, 3 * H])  # one step, and three
def test_derivatives_are_those_of_the_step(arm, h):
    # fails if rows, columns or the inputs' place are exchanged, or the steps of one communication step are not chained
    unknowns, knowns = STATE, (*STATE, *INPUTS)
    start = np.array([0.3, -0.2, 0.1, 0.4, 0.2])

    def end(x):
        assert arm.call("Reset") == 0
        assert arm.set((*STATE, *INPUTS), x) == 0
        arm.initialize()
        assert arm.step(0.0, h) == 0
        return arm.get(STATE)

    slopes = np.stack([(end(start + d) - end(start - d)) / 2e-5 for d in 1e-5 * np.eye(5)], 1)
    end(start)
    columns = [arm.derivative("Directional", unknowns, knowns, seed) for seed in np.eye(5)]
    assert all(status == 0 for status, _ in columns)
    assert abs(np.stack([column for _, column in columns], 1) - slopes).max() <= 1e-8
    if arm.new:
        rows = [arm.derivative("Adjoint", unknowns, knowns, seed)[1] for seed in np.eye(3)]
        assert abs(np.stack(rows) - slopes).max() <= 1e-8
    assert arm.derivative("Directional", INPUTS, STATE, np.ones(3))[0] == ERROR
    assert arm.derivative("Directional", STATE, (0,), np.ones(1))[0] == ERROR
    arm.call("Reset")
    arm.initialize()
    assert arm.derivative("Directional", STATE, STATE, np.ones(3))[0] == ERROR  # no step was made


def test_bad_use_is_an_error_and_changes_nothing(arm):
    # fails if NaN, a step out of range, an unknown reference, a wrong order of calls or no instance is taken, or ends
    # the process
    before = arm.get((*INPUTS, *STATE))
    assert arm.set(INPUTS, (1.0, float("nan"))) == ERROR
    assert arm.set(INPUTS, (float("inf"), 1.0)) == ERROR
    assert arm.set((1, 99), (1.0, 1.0)) == ERROR
    assert arm.set((0,), (1.0,)) == ERROR  # time
    assert arm.set(STATE, (0.0, 0.0, 0.0)) == ERROR  # it runs
    for h in (0.0, -H, float("nan"), float("inf"), H / 3):
        assert arm.step(0.0, h) == ERROR
    assert arm.step(float("nan"), H) == ERROR
    assert arm.get((*INPUTS, *STATE)).tolist() == before.tolist()
    assert arm.real("Get", (99,), (ctypes.c_double * 1)()) == ERROR
    assert any(b"between 0.05 and 0.1" in one[0] for one in arm.said if isinstance(one[0], bytes))
    assert arm.step(0.0, 1.5 * H) == 0  # two steps of 0.075
    saved = arm.state()
    assert arm.step(0.0, H) == 0
    moved = arm.get(STATE)
    assert arm.call(arm.states("Set"), saved) == 0
    assert arm.step(0.0, H * (1 + 1e-9)) == 0
    assert arm.get(STATE).tolist() == moved.tolist()  # fails if rounding of recorded times makes another step
    arm.call(arm.states("Free"), ctypes.byref(saved))
    if not arm.new:
        assert arm.call("EnterInitializationMode") == ERROR
    arm.one = ctypes.c_void_p()
    assert arm.set(INPUTS, (0.0, 0.0)) == ERROR
    assert arm.step(0.0, H) == ERROR
    assert arm.call("Reset") == ERROR
    arm.one = ctypes.c_void_p(arm.fmu.component)
    assert arm.call("Terminate") == 0
    assert arm.step(0.0, H) == ERROR


@pytest.mark.parametrize("version", VERSIONS)
def test_steps_before_initialization_and_other_tokens(version, fmus):
    # fails if a step is made of an instance that is not ready, or another model's description is taken
    one = Instance(fmus[version][1], version, ready=False)
    assert one.step(0.0, H) == ERROR
    one.fmu.freeInstance()
    words = {"unzipDirectory": str(fmus[version][1]), "modelIdentifier": "arm", "instanceName": "two"}
    other = one.fmu.__class__(guid="of another model", **words)
    with pytest.raises(Exception, match="nstantiate"):
        other.instantiate()


def test_leaving_the_data_is_a_warning(arm):
    # fails if a motion beyond the box goes on in silence, or stops
    assert arm.call("Reset") == 0
    assert arm.set((3,), (0.0,)) == 0
    assert arm.set((4,), (8.99,)) == 0
    arm.initialize()
    assert arm.set(INPUTS, (500.0, 500.0)) == 0
    statuses = [arm.step(k * H, H) for k in range(4)]
    assert statuses[-1] == 1
    assert set(statuses) <= {0, 1}
    assert sum(b"has left the data" in one[0] for one in arm.said if isinstance(one[0], bytes)) == 1


@pytest.mark.parametrize("version", VERSIONS)
def test_sources_compile_without_a_warning_and_survive_the_sanitizers(version, fmus, tmp_path):
    # fails if the sources need more than C99, a state is read beyond its end, or memory is not given back
    folder = fmus[version][1]
    source = folder / "sources" / f"fmi{version[0]}.c"
    program = tmp_path / "program"
    sanitized = ["-O0", "-g", "-fno-sanitize-recover=all", "-fsanitize=address,undefined"]
    words = [str(CC), "-std=c99", *WARNINGS, *sanitized, f'-DSOURCE="{source}"', f"-DFMI={version[0]}"]
    words += [str(Path(__file__).with_name("fmu_program.c")), "-o", str(program), "-lm"]
    built = run_compiler(words)
    assert built.returncode == 0, built.stderr[:2000]
    done = subprocess.run([str(program)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr[:2000]
    assert float(done.stdout) == pytest.approx(100 * H)


def test_other_models(tmp_path, monkeypatch):
    # fails if a model without inputs, with sticking friction, of floats or of many coordinates has no FMU
    from fmpy.validation import validate_fmu

    models = {"float64": with_terms("sticking"), "float32": damped("linear", torch.float32)}
    for dtype, model in models.items():
        path = export_fmu(model, tmp_path / f"{dtype}.fmu", h=H, dtype=dtype)
        assert validate_fmu(str(path)) == []
        assert len(fmpy.simulate_fmu(str(path), stop_time=0.5, output_interval=H)) == 6
    monkeypatch.setenv("CC", "no_such_compiler")
    with pytest.warns(RuntimeWarning, match="sources without a binary"):
        path = export_fmu(model_of(9, "linear"), tmp_path / "many.fmu", h=H)
    assert validate_fmu(str(path)) == []
    assert not any("binaries" in name for name in zipfile.ZipFile(path).namelist())
    description = zipfile.ZipFile(path).read("modelDescription.xml")
    assert b'providesDirectionalDerivatives="false"' in description
    with pytest.raises(InputError, match="version must be one of 3"):
        export_fmu(models["float32"], path, h=H, version="1.0")


def test_the_binary_is_for_every_processor_of_the_kind(tmp_path, monkeypatch):
    # fails if an FMU ends with an illegal instruction on another machine, or a compiler's error is a mere warning
    used = []
    monkeypatch.setattr(c_compiler, "_compile", lambda _, sources, flags: used.append((sources, flags)) or b"")
    path = export_fmu(damped("linear", torch.float64), tmp_path / "arm.fmu", h=H)
    assert not any("native" in flag for flag in used[0][1])
    assert "-std=c99" in used[0][1]
    monkeypatch.undo()
    with pytest.raises(InputError, match="does not compile"):
        c_compiler.portable_library({c_compiler.SOURCE: "int x = y;"})
    folders = {name.rpartition("/")[0] for name in zipfile.ZipFile(path).namelist() if name.startswith("binaries/")}
    assert folders == {f"binaries/{fmpy.platform_tuple}"}


def test_a_damaged_fmu_is_refused(fmus, tmp_path):
    # fails if a changed FMU, or one that another tool wrote, is opened
    content = fmus["3.0"][0].read_bytes()
    (tmp_path / "cut.fmu").write_bytes(content[:-100])
    with pytest.raises(InputError, match="cut off"):
        load_exported(tmp_path / "cut.fmu")
    metadata = load_exported(fmus["2.0"][0]).metadata
    assert json.dumps(metadata["start"]) == json.dumps(METADATA["start"])
