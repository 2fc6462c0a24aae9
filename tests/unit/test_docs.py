"""What README, its like and docs/ name exists: code, files, links, commands, flags, parts of the mathematics."""

import argparse
import importlib
import re
from pathlib import Path

import pytest

from herglotz.cli.parser import build_parser

ROOT = Path(__file__).resolve().parents[2]
FACE = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "benchmarks/fetch.md")]
PAGES = [*FACE, *sorted((ROOT / "docs").rglob("*.md"))]
CODE = {p: p.read_text(encoding="utf-8") for room in ("src", "tests", "train", "benchmarks", "tools", "examples")
        for p in sorted((ROOT / room).rglob("*.py")) if p != Path(__file__).resolve()}  # fmt: skip
RUNTIME = [p.read_text(encoding="utf-8") for p in sorted((ROOT / "src").rglob("*.h"))]  # of the generated C
EVERYTHING = " ".join([*map(str, CODE), *CODE.values(), *RUNTIME])
# Names of the generated C stand behind a prefix there.
WORDS = set(re.findall(r"\w+", EVERYTHING)) | set(re.findall(r"(?<=_)[A-Za-z]\w+", EVERYTHING))
FILES = [p.relative_to(ROOT) for room in ("src", "tests", "train", "benchmarks", "tools", "docs", "data", "examples")
         for p in (ROOT / room).rglob("*")] + [p.relative_to(ROOT) for p in ROOT.glob("*")]  # fmt: skip
# Files that extending.md tells the reader to write, and those of a reader of c.md.
WRITTEN = ("data/whitespace.py", "plots/misses.py", "export/as_json.py")
EXAMPLES = {"whitespace.py", "example.c", *(f"src/herglotz/{name}" for name in WRITTEN)}
by_page = pytest.mark.parametrize("path", PAGES, ids=lambda p: p.name)


def prose(text):
    return re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)


def in_backticks(text):
    return re.findall(r"`([^`\n]+)`", prose(text))


def fences(text, *kinds):
    return "\n".join(body for kind, body in re.findall(r"^```(\w*)\n(.*?)^```", text, re.M | re.S) if kind in kinds)


def anchors(text):
    """The anchors of a page's headings, as GitHub writes them."""
    headings = re.findall(r"^#+ (.+)$", prose(text), re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


MATHEMATICS = {
    item
    for heading in anchors((ROOT / "docs" / "mathematics.md").read_text(encoding="utf-8"))
    for item in re.findall(r"^(?:e\d+|trap-\d+|\d+)", heading)
}


def cited(text):
    """Sections, traps and errata that a text cites, spelled as in `MATHEMATICS`."""
    for kind, numbers in re.findall(r"\b(section|trap|errat)(?:s|um|a)? ((?:E?\d+(?:–| and |, (?=E?\d))?)+)", text):
        found = [int(n) for n in re.findall(r"\d+", numbers)]
        span = range(found[0], found[-1] + 1) if "–" in numbers else found
        yield from ({"section": "", "trap": "trap-", "errat": "e"}[kind] + str(n) for n in span)


def test_citations_of_the_mathematics_exist():
    # fails if a docstring cites a section, trap or erratum that docs/mathematics.md does not have, or another file
    assert set(cited("sections 1–3, errata E4–E6, trap 2")) == {"1", "2", "3", "e4", "e5", "e6", "trap-2"}
    assert {f"e{n}" for n in range(1, 11)} | {f"trap-{n}" for n in range(1, 7)} | set("123456") <= MATHEMATICS
    for path, text in CODE.items():
        lines = text.splitlines()
        for i, line in enumerate(lines):
            if "mathematics.md" in line:
                sentence = " ".join(lines[max(i - 1, 0) : i + 2])
                assert "docs/mathematics.md" in line, f"{path}, line {i + 1}: write docs/mathematics.md"
                assert set(cited(sentence)), f"{path}, line {i + 1}: name the section, trap or erratum"
                assert set(cited(sentence)) <= MATHEMATICS, f"{path}, line {i + 1}"
        errata_and_traps = {item for item in cited(" ".join(map(str.strip, lines))) if not item.isdigit()}
        assert errata_and_traps <= MATHEMATICS, path


@by_page
def test_links_lead_somewhere(path):
    # fails if a page or heading is renamed and a link to it is not
    text = path.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        name, _, anchor = target.partition("#")
        page = (path.parent / name).resolve() if name else path
        assert target.startswith("http") or page.exists(), target
        assert not anchor or anchor in anchors(page.read_text(encoding="utf-8")), target


def resolve(name):
    """The object that a dotted name means; raises where there is none. A module may share its name with a function."""
    parts = re.sub(r"^hz\b", "herglotz", name).split(".")
    parts = ["herglotz", "environment", *parts[1:]] if parts[1:2] == ["VectorEnv"] else parts
    if parts[1] in ("regressor", "environment"):  # which need an extra to be imported
        assert len(parts) < 3 or f"class {parts[2]}(" in CODE[ROOT / "src" / "herglotz" / f"{parts[1]}.py"]
        return
    for i in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:i]))
        except ModuleNotFoundError:
            continue
        for part in parts[i:]:
            value = getattr(value, part)
        return
    raise ModuleNotFoundError(name)


@by_page
def test_names_of_code_exist(path):
    # fails if a function, class or module is renamed and a page still has its old name
    text = path.read_text(encoding="utf-8")
    for name in re.findall(r"(?<!/)\b(?:herglotz|hz)(?:\.[a-zA-Z_]\w*)+", text):
        if not re.search(r"\.(h|json|py|git|c|gif|models\.quartic)$", name):
            resolve(name)
    for module, names in re.findall(r"^from (herglotz[\w.]*) import ([\w, ]+)", fences(text, "python"), re.M):
        for name in names.split(","):
            resolve(f"{module}.{name.strip()}")
    for word in in_backticks(text) if path.name not in ("paper.md", "errata.md") else ():  # those hold labels of LaTeX
        if re.fullmatch(r"[A-Za-z_][\w.]*(\(.*\))?", word) and word not in EXAMPLES:
            for name in re.findall(r"\w*_\w+|\w*[a-z][A-Z]\w*", re.sub(r"\(.*\)|^herglotz_stepper|^arm_", "", word)):
                assert name in WORDS, word


@by_page
def test_paths_exist(path):
    # fails if a file is moved and a page still names its old place
    for word in in_backticks(path.read_text(encoding="utf-8")):
        for name in re.findall(r"^([\w./{},*-]+(?:\.(?:py|md|toml|cff)|/))(?:::.*)?$", word):
            pattern = re.sub(r"\{.*\}", "*", name).rstrip("/").removeprefix("../")
            found = any(file.match(pattern) for file in FILES)
            assert found or name in EXAMPLES or name.startswith("runs/"), name
    # `file.py` (`name`), `file.py`, `name` and `name` of `file.py` say where a function is
    text = path.read_text(encoding="utf-8")
    for file, name in re.findall(r"`([\w/]+\.py)`(?: \(|, )`(\w+)`", text) + [
        (file, name) for name, file in re.findall(r"`(\w+)` (?:of|in) `([\w/]+\.py)`", text)
    ]:
        sources = [body for p, body in CODE.items() if p.match(file)]
        assert any(re.search(rf"\b{name}\b", body) for body in sources), f"{name} of {file}"


def test_the_drawing_of_imports_is_the_one_enforced():
    # fails if a room is added, renamed or moved and docs/architecture.md still draws the old house
    source = CODE[ROOT / "tests" / "unit" / "test_architecture.py"]
    enforced = re.search(r'^ORDER = "(.*)"', source, re.M)
    assert enforced is not None
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    drawn = [sorted(line.split()) for line in fences(page, "imports").splitlines()]
    assert drawn[::-1] == [sorted(rooms.split()) for rooms in enforced[1].split("|")]
    rooms = {name for level in drawn for name in level}
    assert rooms == {p.parent.name for p in (ROOT / "src" / "herglotz").glob("*/__init__.py")}
    assert rooms <= {word.rstrip("/") for word in in_backticks(page)}


def subcommands():
    action = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return {name: set(sub._option_string_actions) for name, sub in action.choices.items()}


@by_page
def test_commands_and_flags_exist(path):
    # fails if a subcommand, a flag, a script or a make target is renamed and a page still shows the old one
    text = re.sub(r"\\\n\s*", " ", path.read_text(encoding="utf-8"))
    spans = [re.sub(r"\s+", " ", span) for span in re.findall(r"`([^`]+)`", prose(text))]  # a command may be wrapped
    shown = "\n".join([*spans, fences(text, "", "sh", "bash"), *re.findall(r"^ {4}(.*)$", text, re.M)])
    commands = subcommands()
    for name, rest in re.findall(r"^(?:\S*/)?herglotz ([a-z]+)\b([^\n#;]*)", shown, re.M):
        assert name in commands, name
        for flag in re.findall(r"(?<= )--[a-z][\w-]*", rest):
            assert flag in commands[name], f"herglotz {name} {flag}"
    for script, rest in re.findall(r"^(?:\S*/)?python (\w[\w/]+\.py)([^\n#;]*)", shown, re.M):
        assert (ROOT / script).exists(), script
        for flag in re.findall(r"(?<= )--[a-z][\w-]*", rest):
            assert f'"{flag}"' in EVERYTHING, f"{script} {flag}"
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    for target in re.findall(r"^make ([a-z][\w-]*)", shown, re.M):
        assert target in targets, f"make {target}"
