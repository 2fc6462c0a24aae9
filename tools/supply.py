"""What herglotz is installed with: `python tools/supply.py [sbom | licences | lock | check-lock]`.

* `sbom`: the runtime dependencies as CycloneDX 1.5, in build/sbom.json; exit code 1 where a licence is not allowed.
* `licences` writes the table of SECURITY.md anew.
* `lock` lets pip resolve the package with its extra `dev`, and writes lock.txt: versions, and the sha256 of the files
  for this Python and platform.
* `check-lock` lets pip fetch what lock.txt names and compare the hashes. Nothing is installed; on another Python or
  platform, or where pip reaches no package index, or another one than the lock's, nothing is checked, and that is said.
"""

from __future__ import annotations

import argparse
import json
import platform
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import Any
from urllib.parse import quote

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
LOCK, SECURITY, SBOM = ROOT / "lock.txt", ROOT / "SECURITY.md", ROOT / "build" / "sbom.json"
TABLE = re.compile(r"\| package \| licence \|\n(?:\|.*\n)+")
# Python without its patch level, and the platform: what wheels are made for.
HERE = f"{platform.python_implementation()} {platform.python_version().rpartition('.')[0]} " + (
    f"{platform.system()} {platform.machine()}"
)
ALLOWED = {"0BSD", "Apache-2.0", "BSD", "BSD License", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0", "MIT",
           "LLVM-exception", "MIT-CMU", "MPL-2.0", "PSF-2.0", "Python Software Foundation License", "Zlib"}  # fmt: skip
# Proprietary parts of torch's CUDA builds, which herglotz does not need.
CUDA = ("nvidia-", "cuda-")
# pip's message if no index is reached or the index has no such file, and the versions that the index has instead.
NO_FILE = re.compile(r"No matching distribution found for (\S+)")
LISTED = re.compile(r"\(from versions: (.*)\)")
# An index that lacks more files than this is another index than the lock's: so many lines are not mistyped at once.
MAX_MISSING = 3
# Letters of a licence's name. A longer field holds the text of the licence.
MAX_NAME = 60


def project() -> dict[str, Any]:
    """The table `project` of pyproject.toml, and the requirements to build it as `build`."""
    read = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return read["project"] | {"build": read["build-system"]["requires"]}


def runtime() -> list[Distribution]:
    """What the package requires without extras, directly or not, as it is installed here; by name."""
    found: dict[str, Distribution] = {}
    left = [Requirement(line) for line in project()["dependencies"]]
    while left:
        name = canonicalize_name(left.pop().name)
        if name not in found:
            found[name] = distribution(name)
            needed = map(Requirement, found[name].requires or [])
            left += [r for r in needed if r.marker is None or r.marker.evaluate({"extra": ""})]
    return [found[name] for name in sorted(found)]


def licence(package: Distribution) -> str:
    """SPDX expression where the package has one, or the name that it gives its licence; "" where it gives none."""
    # A field that appears several times is a list.
    said = package.metadata.json
    field = str(said.get("license", ""))
    named = [line.rpartition(" :: ")[2] for line in said.get("classifier", []) if line.startswith("License ::")]
    return str(said.get("license_expression", "")) or (field if 0 < len(field) < MAX_NAME else " AND ".join(named))


def allowed(words: str) -> bool:
    """Whether every licence that an expression names is one of `ALLOWED`."""
    return set(re.split(r" (?:AND|OR|WITH) ", words.replace("(", "").replace(")", ""))) <= ALLOWED


def sbom(packages: Iterable[Distribution]) -> dict[str, Any]:
    """The packages as CycloneDX 1.5."""
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": {"type": "library", "name": "herglotz", "version": distribution("herglotz").version}},
        "components": [_component(package) for package in packages],
    }


def _component(package: Distribution) -> dict[str, Any]:
    words = licence(package)
    spdx = "License-Expression" in package.metadata
    made = [{"expression": words}] if spdx else [{"license": {"name": words}}] if words else []
    purl = f"pkg:pypi/{canonicalize_name(package.name)}@{quote(package.version)}"
    return {"type": "library", "bom-ref": purl, "name": package.name, "version": package.version,
            "licenses": made, "purl": purl}  # fmt: skip


def table(packages: Iterable[Distribution]) -> str:
    """Names and licences, in Markdown."""
    rows = [f"| {canonicalize_name(package.name)} | {licence(package)} |" for package in packages]
    return "\n".join(["| package | licence |", "|---|---|", *rows, ""])


def lock() -> str:
    """What pip takes for the package, its extra `dev` and its build; with hashes."""
    wanted = project()
    extras = wanted["optional-dependencies"]
    # pip cannot give a hash for the package's own folder: its requirements instead
    lines = [*wanted["build"], *wanted["dependencies"], *extras["dev"]]
    lines += [*extras["export"], *extras["control"], *extras["gymnasium"]]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        ours = ("--report", str(report), "--constraint", str(ROOT / "constraints.txt"))
        said = _resolve(*ours, *(line for line in lines if not line.startswith("herglotz[")))
        if said:
            sys.exit(said)
        taken = json.loads(report.read_text(encoding="utf-8"))["install"]
    return f"# {HERE}. Written by `python tools/supply.py lock`; SECURITY.md says what for.\n" + "".join(sorted(
        f"{canonicalize_name(one['metadata']['name'])}=={one['metadata']['version']}"
        f" --hash=sha256:{one['download_info']['archive_info']['hashes']['sha256']}\n" for one in taken))  # fmt: skip


def _resolve(*words: str) -> str:
    """What went wrong in `pip install` without installing; a package that is there already is fetched all the same."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--only-binary=:all:"]
    done = subprocess.run([*pip, *words], check=False, stderr=subprocess.PIPE, text=True)
    return (done.stderr or f"pip ended with {done.returncode}") if done.returncode else ""


def check_lock() -> None:
    """Let pip compare the hashes of the lock with those of the files that it gets.

    A version that is nowhere is a mistake of the lock where pip finds the other ones; of a build (`+cpu`), where its
    index lacks the plain version too.
    """
    text = LOCK.read_text(encoding="utf-8")
    made_for = text.removeprefix("# ").partition(". ")[0]
    if made_for != HERE:
        print(f"lock.txt is for {made_for}, this is {HERE}: nothing checked")
        return
    lines, missing, builds = [line for line in text.splitlines() if "==" in line], [], []
    said = _checked(lines)
    while len(missing) <= MAX_MISSING and (found := NO_FILE.search(said)):
        (builds if _is_build(found[1], said) else missing).append(found[1])
        lines = [line for line in lines if line.split()[0] != found[1]]
        # Without dependencies: a package that requires the one left out is no mistake of the lock.
        said = _checked(lines, "--no-deps")
    if len(missing) > MAX_MISSING:
        print(f"lock.txt: not checked: no package index, or not the lock's: it lacks {', '.join(missing)} and more")
    elif said or missing:
        sys.exit(said or f"lock.txt: pip finds the other files, and no {', '.join(missing)}: mistyped, or withdrawn?")
    else:
        also = f"; not checked: {', '.join(builds)}, whose index pip was not given" if builds else ""
        print(f"lock.txt: pip gets {len(lines)} packages with these hashes{also}")


def _is_build(requirement: str, said: str) -> bool:
    """Whether a version is a build (`+cpu`) of one that pip has found."""
    plain, _, build = requirement.partition("+")
    others = LISTED.search(said)
    return bool(build and others and plain.rpartition("==")[2] in others[1].split(", "))


def _checked(lines: list[str], *words: str) -> str:
    """What pip says against these lines of a lock; "" where it gets every file with its hash."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lock.txt"
        path.write_text("\n".join(lines), encoding="utf-8")
        return _resolve("--require-hashes", *words, "--requirement", str(path))


def main() -> None:
    """Do what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="sbom", choices=("sbom", "licences", "lock", "check-lock"))
    what, packages = parser.parse_args().what, runtime()
    if what == "sbom":
        SBOM.parent.mkdir(exist_ok=True)
        SBOM.write_text(json.dumps(sbom(packages), indent=1) + "\n", encoding="utf-8")
        print(f"build/sbom.json: {len(packages)} packages")
        others = [package for package in packages if not canonicalize_name(package.name).startswith(CUDA)]
        if refused := [package.name for package in others if not allowed(licence(package))]:
            sys.exit(f"licence missing or not allowed: {', '.join(refused)}")
    elif what == "licences":
        text = SECURITY.read_text(encoding="utf-8")
        SECURITY.write_text(TABLE.sub(lambda _: table(packages), text), encoding="utf-8")
    elif what == "lock":
        LOCK.write_text(lock(), encoding="utf-8")
    else:
        check_lock()


if __name__ == "__main__":
    main()
