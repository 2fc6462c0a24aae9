"""The house rules that a reader relies on, held by the source itself."""

import ast
import sys
from functools import cache
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[2] / "src" / "herglotz"
# A ← B: B may import A. Rooms between two bars may not import one another; errors, settings and threads serve all.
ORDER = "mechanics|models|stepping|scenes|data|codegen|training|export|tune|theory|verify|plots|report|cli"
LEVEL = {room: i for i, rooms in enumerate(ORDER.split("|")) for room in rooms.split()}
RUNTIME = {"torch", "numpy", "matplotlib", "PIL", "tqdm", "herglotz"} | set(
    sys.stdlib_module_names
)  # PIL comes with matplotlib
# Extras that only some users install, with the files that may import them: inside functions, but for those of `ABOVE`.
EXTRAS = {
    "onnx": ("export/lower/onnx*.py", "export/load.py"),
    "onnx_ir": ("export/lower/onnx*.py",),
    "onnxruntime": ("export/lower/onnx*.py", "export/load.py"),
    "onnxscript": ("export/lower/onnx*.py",),
    "sklearn": ("regressor.py",),
    "gymnasium": ("environment.py",),
}
# These stand above the rooms, or are written in onnxscript, and are loaded where they are asked for.
ABOVE = ("environment.py", "regressor.py", "onnx_operations.py")
FILES = sorted(SOURCE.rglob("*.py"))


@cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path):
    return list(imported(ast.walk(parsed(path)), path))


def top_level(path):
    return set(imported(parsed(path).body, path))


def imported(nodes, path):
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SOURCE)))
def test_imports_point_one_way(path):
    # fails if a lower room imports a higher one, or a room its neighbour
    room, outside = path.relative_to(SOURCE).parts[0], top_level(path)
    for name in imports(path):
        parts = name.split(".")
        inside = path.name in ABOVE or name not in outside
        if inside and any(path.match(pattern) for pattern in EXTRAS.get(parts[0], ())):
            continue
        assert parts[0] in RUNTIME, f"{path} imports {name}, which is no runtime dependency"
        assert parts[0] != "train", f"{path} imports a script"
        if parts[0] == "herglotz" and len(parts) > 1 and parts[1] in LEVEL and room in LEVEL and parts[1] != room:
            assert LEVEL[parts[1]] < LEVEL[room], f"{path} imports {name}"


def test_only_the_door_differentiates_lagrangians():
    # fails if a module calls autograd on its own; the exceptions differentiate maps, objectives or parameters
    allowed = {
        "mechanics/partials.py",  # the door
        "mechanics/contact.py",  # the derivative of a flow
        "stepping/linearise.py",  # the derivative of a step
        "training/problems/one_step.py",  # with respect to parameters
        "training/equation_words.py",  # the same
        "training/kernel.py",  # the same
        "training/problems/shooting.py",  # the same
    }
    used = {str(p.relative_to(SOURCE)) for p in FILES if "autograd.grad" in p.read_text(encoding="utf-8")}
    assert used <= allowed, used - allowed


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SOURCE)))
def test_modules_load_safely(path):
    # fails if a module loads a pickle
    text = path.read_text(encoding="utf-8")
    assert text.count("torch.load(") == text.count("weights_only=True"), "torch.load without weights_only=True"
    assert "allow_pickle=True" not in text


@pytest.mark.parametrize("room", sorted(LEVEL))
def test_no_two_files_import_each_other(room):
    # fails if files form a circle, also one that only type checkers see: neither can be read without the other
    paths = [path for path in (SOURCE / room).rglob("*.py") if path.stem != "__init__"]
    names = {".".join(("herglotz", *path.relative_to(SOURCE).with_suffix("").parts)): path for path in paths}
    needs = {name: {m for m in imports(path) if m in names} for name, path in names.items()}
    while free := [name for name, wanted in needs.items() if not wanted]:
        for name in free:
            del needs[name]
        for wanted in needs.values():
            wanted.difference_update(free)
    assert not needs, f"circles among {sorted(needs)}"
