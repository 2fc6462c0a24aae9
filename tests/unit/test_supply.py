"""What is installed with the package: licences, the SBOM, the lock, and the wheel with its requirements alone."""

import re
import subprocess
import sys
import venv
from importlib.metadata import Distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from tools import supply

ROOT = Path(__file__).resolve().parents[2]
ROWS = supply.SECURITY.read_text("utf-8").split("| licence |")[1]
TABLE = dict(re.findall(r"^\| ([a-z0-9-]+) \| (.+) \|$", ROWS, re.M))
LOCKED = re.findall(r"^([\w-]+)==(\S+) --hash=sha256:[0-9a-f]{64}$", supply.LOCK.read_text("utf-8"), re.M)
BSD = "Classifier: Topic :: Scientific\nClassifier: License :: OSI Approved :: BSD License"


class Package(Distribution):
    """A distribution that has metadata alone."""

    def __init__(self, *fields):
        self.text = "\n".join(["Name: example", *fields, ""])

    def read_text(self, filename):
        return self.text if filename == "METADATA" else None

    def locate_file(self, path):
        raise FileNotFoundError(path)


def test_the_table_has_every_runtime_package_and_its_licence():
    # fails if a requirement is added and not listed, or has another licence in the version of the lock
    here = {canonicalize_name(p.name): p for p in supply.runtime()}
    direct = {Requirement(line).name for line in supply.project()["dependencies"]}
    assert direct <= TABLE.keys() <= dict(LOCKED).keys()
    same = {name: p for name, p in here.items() if (name, p.version) in LOCKED}
    assert {name: supply.licence(p) for name, p in same.items()} == {name: TABLE.get(name) for name in same}


def test_every_licence_of_the_table_is_allowed():  # fails if a package with a forbidden or no licence comes in
    assert TABLE
    assert [name for name, words in TABLE.items() if not supply.allowed(words)] == []


@pytest.mark.parametrize("words", ["", "GPL-3.0-only", "MIT AND GPL-3.0-only", "(MIT OR AGPL-3.0-only) AND Zlib"])
def test_other_licences_are_not_allowed(words):  # fails if a part of an expression is not looked at
    assert not supply.allowed(words)
    assert supply.allowed("(MIT OR Zlib) AND 0BSD")


def test_the_licence_is_the_most_exact_that_a_package_gives():
    # fails if a licence's text is taken for its name, or a classifier preferred to an SPDX expression
    assert supply.licence(Package("License-Expression: BSD-3-Clause", "License: BSD", BSD)) == "BSD-3-Clause"
    assert supply.licence(Package("License: MIT", BSD)) == "MIT"
    assert supply.licence(Package(f"License: {'Redistribution and use ' * 9}", BSD)) == "BSD License"
    assert supply.licence(Package()) == ""


def test_the_sbom_has_what_cyclonedx_requires():
    # fails if a key is missing, a name is given twice, or words that are no SPDX expression are called one
    packages = supply.runtime()
    made = supply.sbom(packages)
    assert (made["bomFormat"], made["specVersion"], made["version"]) == ("CycloneDX", "1.5", 1)
    assert made["metadata"]["component"]["name"] == "herglotz"
    parts = made["components"]
    assert len({part["purl"] for part in parts}) == len(parts) == len(packages) > len(supply.project()["dependencies"])
    for part, package in zip(parts, packages, strict=True):
        assert (part["type"], part["bom-ref"]) == ("library", part["purl"])
        assert part["version"] == package.version
        assert re.fullmatch(r"pkg:pypi/[a-z0-9-]+@[\w.%-]+", part["purl"])
        for one in part["licenses"]:
            spdx = "License-Expression" in package.metadata
            assert (one["expression"] if spdx else one["license"]["name"]) == supply.licence(package)


def test_the_lock_agrees_with_the_requirements():  # fails if a pin or a requirement changes and the lock does not
    versions = dict(LOCKED)
    text = (ROOT / "constraints.txt").read_text("utf-8")
    pins = dict(re.findall(r"^([\w-]+)==(\S+)$", text, re.M))
    assert pins == {name: versions[name].partition("+")[0] for name in pins}
    wanted = supply.project()
    lines = [*wanted["dependencies"], *wanted["optional-dependencies"]["dev"], *wanted["build"]]
    for needed in map(Requirement, lines):
        assert needed.name == "herglotz" or versions[needed.name] in needed.specifier, needed


def test_the_lock_is_not_checked_on_another_platform(monkeypatch, capsys):  # fails if `make supply` fails there
    monkeypatch.setattr(supply, "HERE", "CPython 3.11 Plan9 mips")
    monkeypatch.setattr(supply, "_resolve", lambda *_: pytest.fail("pip was asked"))
    supply.check_lock()
    assert "this is CPython 3.11 Plan9 mips: nothing checked" in capsys.readouterr().out


def pip_that_lacks(monkeypatch, lacks, listed="1.0"):
    """Let pip find all files but these, of which it has other versions."""

    def resolve(*words):
        lines = Path(words[-1]).read_text("utf-8").splitlines()
        for name in (line.split()[0] for line in lines):
            if lacks(name):
                what = f"{name} (from versions: {listed})"
                return f"ERROR: Could not find a version {what}\nERROR: No matching distribution found for {name}\n"
        return ""

    monkeypatch.setattr(supply, "HERE", supply.LOCK.read_text("utf-8").removeprefix("# ").partition(". ")[0])
    monkeypatch.setattr(supply, "_resolve", resolve)


def test_the_lock_is_not_checked_without_its_package_index(monkeypatch, capsys):
    # fails if a machine without a network, or with an index of other versions, fails
    for lacks in (lambda _: True, lambda name: name[0] < "p"):
        pip_that_lacks(monkeypatch, lacks)
        supply.check_lock()
        assert "not checked: no package index, or not the lock's: it lacks attrs==" in capsys.readouterr().out


def test_a_version_that_is_nowhere_fails(monkeypatch, tmp_path):
    # fails if a mistyped version in lock.txt passes for a missing index
    mistyped = re.sub("^(tqdm==).*? ", r"\g<1>99.9 ", supply.LOCK.read_text("utf-8"), flags=re.M)
    (tmp_path / "lock.txt").write_text(mistyped, "utf-8")
    pip_that_lacks(monkeypatch, lambda name: name == "tqdm==99.9")
    supply.check_lock()
    monkeypatch.setattr(supply, "LOCK", tmp_path / "lock.txt")
    with pytest.raises(SystemExit, match=r"pip finds the other files, and no tqdm==99.9: mistyped, or withdrawn"):
        supply.check_lock()


def test_a_build_that_another_index_has_is_told_apart(monkeypatch, capsys):
    # fails if an index without torch's builds for processors alone fails, or hides that it was not checked
    (torch,) = (f"torch=={version}" for name, version in LOCKED if name == "torch")
    plain = torch.rpartition("==")[2].partition("+")[0]
    pip_that_lacks(monkeypatch, lambda name: name == torch, f"2.0.0, {plain}")
    supply.check_lock()
    told = capsys.readouterr().out
    assert f"pip gets {len(LOCKED) - 1} packages" in told
    assert f"not checked: {torch}, whose index pip was not given" in told
    pip_that_lacks(monkeypatch, lambda name: name == torch)
    with pytest.raises(SystemExit, match="mistyped, or withdrawn"):
        supply.check_lock()


def test_another_hash_fails(monkeypatch):  # fails if a file with another hash passes for a missing one
    pip_that_lacks(monkeypatch, lambda _: False)
    for said in ("ERROR: THESE PACKAGES DO NOT MATCH THE HASHES", "ERROR: In --require-hashes mode, all requirements"):
        monkeypatch.setattr(supply, "_resolve", lambda *_, said=said: said)
        with pytest.raises(SystemExit, match=re.escape(said)):
            supply.check_lock()


@pytest.mark.slow
def test_the_wheel_and_its_requirements_alone_run_the_example_of_the_readme(tmp_path):
    # fails if the wheel lacks a file, a module imports what is no requirement, or the README's example does not run
    pip = [sys.executable, "-m", "pip"]
    words = [*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, ROOT]
    built = subprocess.run(words, check=False, capture_output=True, text=True)
    if supply.NO_FILE.search(built.stderr):
        pytest.skip("not checked: no package index, from which pip takes what builds a wheel")
    assert built.returncode == 0, built.stderr
    venv.create(tmp_path / "env")
    python = tmp_path / "env" / "bin" / "python"
    subprocess.run([*pip, "--python", python, "install", "--quiet", "--no-deps", *tmp_path.glob("*.whl")], check=True)
    (site,) = (tmp_path / "env" / "lib").glob("python*/site-packages")
    for package in supply.runtime():
        for top in {path.parts[0] for path in package.files or []} - {"..", "__pycache__"}:
            (site / top).symlink_to(Path(str(package.locate_file(top))))
    readme = (ROOT / "README.md").read_text("utf-8")
    recordings = re.findall(r"^(herglotz simulate .*)$", readme, re.M)
    assert len(recordings) == 2
    (example,) = re.findall(r"^```python\n(import herglotz.*?)^```", readme, re.M | re.S)
    folder = tmp_path / "work"
    folder.mkdir()
    for line in recordings:
        words = line.split()[1:]
        subprocess.run([python.with_name("herglotz"), *words], cwd=folder, env={"HOME": str(tmp_path)}, check=True)
    code = f"{example}\nprint(hz.__file__)"
    words = [python, "-I", "-W", "error", "-c", code]
    said = subprocess.run(
        words, cwd=folder, env={"MPLBACKEND": "Agg"}, check=True, capture_output=True, text=True
    ).stdout
    assert said.splitlines()[-1].startswith(str(site))
    assert "fits to the noise" in said
    assert {"motion.png", "motion.h", "report"} <= {path.name for path in folder.iterdir()}
    assert (folder / "report" / "report.html").stat().st_size > 0
