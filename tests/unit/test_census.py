"""`tools/census.py` finds what it counts: planted cases, and the circles of the source itself."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest

FILE = Path(__file__).resolve().parents[2] / "tools" / "census.py"
spec: Any = importlib.util.spec_from_file_location("census", FILE)
census: Any = importlib.util.module_from_spec(spec)
spec.loader.exec_module(census)

NEWTON = """
import torch

BARE = 3
TOLERANCE = 1e-8  # rounding of the residual
TITLE = "no number"

def solver(equation, x):
    while True:
        F, J = equation(x)
        step = torch.linalg.solve_ex(J, F)[0]
        if step.abs().max() < TOLERANCE:
            return x
        x = x - step

def fixed(J, F):
    for _ in range(3):
        F = torch.linalg.solve_ex(J, F)[0]
    return F

class Motion:
    def rollout(self, state, steps):
        for _ in range(steps):
            state = self.step(state)
        return state

    def delegated(self, state, steps):
        return self.rollout(state, steps)

def train(optimiser):
    for _ in range(3):
        optimiser.step()
"""
WIDE = "def wide(self, a, b, c, d, e, f, *, g):\n" + "    a = a\n" * 40 + "\ndef _fits(a):\n    return wide\n"
FILES = {
    "src/herglotz/stepping/newton.py": NEWTON,
    "src/herglotz/stepping/wide.py": WIDE,
    "src/herglotz/export/runtime/solve.h": "static inline int NAME_solve(const NAME_problem *P) {\n}\n",
    "src/herglotz/export/runtime/api.h": "int NAME_rollout(long steps) {\n}\n",
    "train/fit.py": "from herglotz.stepping.newton import solver\n",
    "tests/unit/test_x.py": "from herglotz.stepping.newton import fixed, Motion, train\nX = 3\n",
}


@pytest.fixture(scope="module")
def found():
    return census.census(FILES)


def test_lines_are_counted_in_their_room(found):
    # fails if tests count, a header is forgotten, or a file is counted in two rooms
    lines = found["lines"]
    assert lines["export"] == 4
    assert lines["train/"] == 1
    assert lines["mechanics, theory, stepping"] == NEWTON.count("\n") + WIDE.count("\n")
    assert lines["outside tests"] == lines["src"] + 1 == NEWTON.count("\n") + WIDE.count("\n") + 5


def test_planted_loops_are_found_and_no_others(found):
    # fails if a Newton loop in Python or C is missed, or a loop that delegates, trains or does not iterate is counted
    names = {kind: [x.split()[-1] for x in found["found"][kind]] for kind in ("Newton loops", "rollout drivers")}
    assert sorted(names["Newton loops"]) == ["NAME_solve(", "solver"]
    assert sorted(names["rollout drivers"]) == ["NAME_rollout(", "rollout"]


def test_planted_functions_names_and_constants_are_found(found):
    # fails if `self` counts as a parameter, a test counts as a caller, or a comment does not explain a constant
    assert [x.split()[1:] for x in found["found"]["wide functions"]] == [["wide", "7"]]
    assert [x.split()[1:] for x in found["found"]["long functions"]] == [["wide", "41"]]
    assert [x.split()[-1] for x in found["found"]["uncalled names"]] == ["fixed", "Motion", "train"]
    assert found["found"]["bare constants"] == ["src/herglotz/stepping/newton.py BARE"]


def test_prose_behind_code_and_pronouns_are_counted():
    # fails if a shape or a word for a tool counts as prose, or words below the head of a file count
    text = '"""It is what they are."""\n\nX = 1  # prose\nY = 2  # (N,) a shape\nZ = 3  # noqa: F401\n# such a line\n'
    assert census.hanging(text) == [3]
    path, tree = "src/herglotz/a.py", census.ast.parse(text)
    found = census.words({path: text}, {path: tree})
    assert found["pronouns"] == 60  # it, what, they of five words
    assert found["decisions"] == 0
    assert found["letters a line"] == round(sum(map(len, text.split("\n"))) / 5, 1)


@pytest.mark.parametrize(
    ("body", "ways"),
    [("return a", 1), ("return a if a else b", 2), ("return a and b or c", 3), ("return [x for x in a if x]", 3),
     ("while a:\n  try: f()\n  except ValueError: pass\n  if a: pass\n  elif b: pass", 5)],
)  # fmt: skip
def test_complexity(body, ways):
    # fails if a branch, an operand or a condition of a comprehension is not counted
    lines = "".join(f"  {line}\n" for line in body.splitlines())
    assert census.complexity(census.ast.parse(f"def f(a, b, c):\n{lines}")) == ways


def test_circles_are_found_through_packages_and_only_where_they_are():
    # fails if a name that a package passes on hides a circle, or makes one of files that do not import each other
    files = {
        "src/herglotz/a/__init__.py": "from herglotz.a.one import f\nfrom herglotz.a.two import g\n",
        "src/herglotz/a/one.py": "def f():\n    from herglotz.a import g\n",
        "src/herglotz/a/two.py": "from herglotz.b import three\n",
        "src/herglotz/b/__init__.py": "",
        "src/herglotz/b/three.py": "x = 1\n",
    }
    assert census.circles(census.imports(files)) == []
    files["src/herglotz/b/three.py"] = "from herglotz.a import f\n"
    assert census.circles(census.imports(files)) == [
        ["src/herglotz/a/one.py", "src/herglotz/a/two.py", "src/herglotz/b/three.py"]
    ]


def test_no_file_imports_itself_in_a_circle():
    # fails if two files of src import each other, directly or through others
    assert census.circles(census.imports(census.sources(None))) == []
