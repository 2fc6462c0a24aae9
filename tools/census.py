"""Count what the project is made of: `python tools/census.py [--json] [--list] [--against REV]`.

Everything is counted in the source itself, by its syntax tree and its text; nothing is imported or run. `--against REV`
counts another revision as well and prints before → after; `--list` names every finding.

* Lines: `wc -l` of .py, .c and .h files of a room, which is a folder of src/herglotz, or train, benchmarks, tools.
* Long functions: more than 40 lines without the docstring. Parameters: more than 6, `self` and `cls` not counted.
* Complexity: 1, and 1 for each if, loop, except, case, conditional expression, comprehension, its conditions, and each
  further operand of `and` and `or`.
* Newton loops: functions with a `while`, or a `for` with a `break`, in which a linear problem is solved (there or in a
  helper of the same file), or with a `while_loop` in a file that names Newton; in C functions NAME_…solve that take no
  matrix. Least squares of training, which solve normal equations, are not counted.
* Rollout drivers: functions with a loop in which a step is taken, or named rollout with a loop; in C NAME_…rollout.
* Circles: files of src that import each other, directly or not, for types or inside functions too; a name imported from
  a package counts as from the file that defines it.
* Uncalled names: public functions and classes of a module that nothing names but their own file, re-exports and tests.
* Bare constants: names in capitals with a number in their value and no comment beside or above.
* Hanging comments: comments of src behind code, without shapes, which begin with a bracket, and words for tools.
* Words and lines of src: pronouns in the heads of files, of 100 words; letters of a line that is not blank; decisions,
  which are complexity without the 1 of each function, of 100 lines.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import subprocess
import tarfile
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
# Path from the root of the repository → text.
Files = dict[str, str]
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
LOOPS = (ast.For, ast.While)
# Lines of a function, and its parameters, above which the function is long or wide.
LONG, WIDE = 40, 6
# Rooms and the lines they may have (docs/architecture.md); `systems` is what `scenes` was called.
BUDGETS = {
    "errors, settings, version": (("src",), 150),
    "mechanics, theory, stepping": (("mechanics", "theory", "stepping"), 5400),
    "scenes": (("scenes", "systems"), 2000),
    "models": (("models",), 1900),
    "data": (("data",), 3300),
    "training": (("training",), 3800),
    "export": (("export",), 5000),
    "tune, verify, plots, cli": (("tune", "verify", "plots", "cli"), 3700),
    "train/": (("train/",), 650),
    "benchmarks/": (("benchmarks/",), 4500),
    "tools/, data/, examples/": (("tools/", "data/", "examples/"), 350),
}
# Of issues 14 and 43, with the budgets above.
GOALS = {
    "src": 30_000, "outside tests": 36_500, "tests": 29_000, "complexity": 15, "Newton loops": 3, "rollout drivers": 2,
    "circles": 0, "hanging comments": 150, "pronouns": 3.0, "letters a line": 46, "decisions": 9.0,
}  # fmt: skip
BRANCHES = (ast.If, ast.IfExp, ast.For, ast.AsyncFor, ast.While, ast.ExceptHandler, ast.comprehension, ast.match_case)
# Names of functions that solve a linear problem.
SOLVE = re.compile(r"(^|_)(solve|solver|solve_ex|inv_ex|pseudo_inverse)$")
STEP = re.compile(r"^(?!.*(optim|schedule)).*\.(step|take|advance)$")
NO_PROSE = re.compile(r"#\s*(\(|noqa|type:|pyright:|fmt:)")  # comments for shapes and for tools
PRONOUNS = re.compile(r"\b(it|they|them|one|ones|such|what|whose|those)\b", re.I)
C_NEWTON = re.compile(r"^\s*(?:static |inline |int |void )+\w*_solve\((?!real)", re.M)
C_ROLLOUT = re.compile(r"^\s*(?:static |inline |int |long |void )+\w*_rollout\(", re.M)


def sources(revision: str | None) -> Files:
    """Text of every Python, C and Markdown file, of the working tree or of a revision."""
    kinds = (".py", ".c", ".h", ".md")
    if revision is None:
        listed = _git("ls-files", "--cached", "--others", "--exclude-standard").decode().splitlines()
        return {p: (ROOT / p).read_text("utf-8") for p in listed if p.endswith(kinds) and (ROOT / p).is_file()}
    with tarfile.open(fileobj=io.BytesIO(_git("archive", revision))) as archive:
        members = [m for m in archive if m.isfile() and m.name.endswith(kinds)]
        return {m.name: archive.extractfile(m).read().decode() for m in members}  # type: ignore[union-attr]


def _git(*words: str) -> bytes:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, check=True).stdout


def room(path: str) -> str:
    """Room of a file: "training" of src/herglotz/training/fit.py, "src" of src/herglotz/errors.py, or the folder."""
    parts = path.split("/")
    return f"{parts[0]}/" if parts[0] != "src" else parts[2] if len(parts) > 3 else "src"


def complexity(function: ast.AST) -> int:
    """Number of ways through a function, the functions inside it included."""
    nodes = list(ast.walk(function))
    more = sum(len(n.values) - 1 for n in nodes if isinstance(n, ast.BoolOp))
    more += sum(len(n.ifs) for n in nodes if isinstance(n, ast.comprehension))
    return 1 + more + sum(isinstance(n, BRANCHES) for n in nodes)


def length(function: Any) -> int:
    """Lines from `def` to the end, without the docstring."""
    first = function.body[0]
    documented = ast.get_docstring(function) is not None
    return function.end_lineno - function.lineno + 1 - documented * (first.end_lineno - first.lineno + 1)


def parameters(function: Any) -> int:
    """Number of parameters without `self` and `cls`."""
    a = function.args
    return sum(x.arg not in ("self", "cls") for x in (*a.posonlyargs, *a.args, *a.kwonlyargs))


def called(node: ast.AST) -> set[str]:
    """Last parts of the names of all functions that are called below a node."""
    found = [n.func for n in ast.walk(node) if isinstance(n, ast.Call)]
    return {f.attr if isinstance(f, ast.Attribute) else f.id for f in found if isinstance(f, ast.Attribute | ast.Name)}


def newton_loops(tree: ast.Module, text: str) -> Iterator[str]:
    """Functions with a loop that ends early (`while`, or `break`) and solves a linear problem in every turn."""
    functions = {f.name: f for f in ast.walk(tree) if isinstance(f, FUNCTIONS)}
    solvers = solving({name: called(f) for name, f in functions.items()})
    named = "newton" in text.lower()
    for name, function in functions.items():
        solved = any(c in solvers or SOLVE.search(c) for loop in early_loops(function) for c in called(loop))
        if solved or (named and any("while_loop" in c for c in called(function))):
            yield f"{function.lineno} {name}"


def solving(calls: dict[str, set[str]]) -> set[str]:
    """Functions that solve a linear problem, themselves or by what they call; `calls` has what each calls."""
    found = {name for name, names in calls.items() if any(map(SOLVE.search, names))}
    while further := {name for name, names in calls.items() if names & found} - found:
        found |= further
    return found


def early_loops(function: ast.AST) -> list[ast.AST]:
    """Loops that may end before their range does."""
    loops = [n for n in ast.walk(function) if isinstance(n, LOOPS)]
    return [n for n in loops if isinstance(n, ast.While) or any(isinstance(m, ast.Break) for m in ast.walk(n))]


def drives(function: Any) -> bool:
    """Whether a function itself holds a loop in which a step is taken: `for k in …: … step(state, …)`."""
    inner = {m for n in ast.walk(function) if isinstance(n, FUNCTIONS) and n is not function for m in ast.walk(n)}
    loops = [n for n in ast.walk(function) if isinstance(n, LOOPS) and n not in inner]
    calls = [ast.unparse(n.func) for loop in loops for n in ast.walk(loop) if isinstance(n, ast.Call)]
    return any(map(STEP.search, calls)) or ("rollout" in function.name and bool(loops))


def imports(files: Files) -> dict[str, set[str]]:
    """Which files of src each file of src imports; names that a package re-exports lead to where they are defined."""
    paths = [p for p in files if p.startswith("src/") and p.endswith(".py")]
    module = {p[4:-3].replace("/", ".").removesuffix(".__init__"): p for p in paths}
    trees = {p: ast.parse(files[p]) for p in paths}
    found: dict[str, set[str]] = {}
    for path, tree in trees.items():
        # A package only passes names on.
        names = [] if path.endswith("__init__.py") else references(tree)
        origins = {_origin(module, trees, *x) if x[1] else module.get(x[0]) for x in names}
        found[path] = {f for f in origins if f} - {path}
    return found


def references(tree: ast.Module) -> list[tuple[str, str]]:
    """(module, name) of every `from module import name`, (module, "") of every `import module`."""
    nodes = list(ast.walk(tree))
    named = [(n.module or "", a.name) for n in nodes if isinstance(n, ast.ImportFrom) for a in n.names]
    return named + [(a.name, "") for n in nodes if isinstance(n, ast.Import) for a in n.names]


def _origin(module: dict[str, str], trees: dict[str, ast.Module], package: str, name: str) -> str | None:
    """File that defines `name` of a module, or the submodule of that name."""
    if f"{package}.{name}" in module:
        return module[f"{package}.{name}"]
    path = module.get(package)
    if path is None or not path.endswith("__init__.py"):
        return path
    for node in trees[path].body:
        if isinstance(node, ast.ImportFrom) and name in (a.asname or a.name for a in node.names):
            return _origin(module, trees, node.module or "", name)
    return path


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Groups of files each of which reaches every other one of its group by imports."""
    reach = {path: set(files) for path, files in edges.items()}
    # The transitive closure by Warshall's algorithm.
    for middle in reach:
        for ends in reach.values():
            if middle in ends:
                ends |= reach[middle]
    groups = {tuple(sorted(q for q in reach[p] if p in reach[q])) for p in reach if p in reach[p]}
    return [list(group) for group in sorted(groups)]


def uncalled(files: Files) -> list[str]:
    """Public functions and classes of src that no other file but a test or a re-exporting `__init__` names."""
    readers = {p: t for p, t in files.items() if not p.startswith("tests/") and not p.endswith("CHANGELOG.md")}
    words = {p: Counter(re.findall(r"\w+", _without_imports(p, t))) for p, t in readers.items()}
    everywhere = Counter(word for count in words.values() for word in count)
    found = []
    for path in (p for p in readers if p.startswith("src/") and p.endswith(".py")):
        for node in ast.parse(files[path]).body:
            # Functions and classes alone have a name.
            name = getattr(node, "name", "_")
            if not name.startswith("_") and everywhere[name] == words[path][name] == 1:
                found.append(f"{path}:{node.lineno} {name}")
    return found


def _without_imports(path: str, text: str) -> str:
    """The text of a file; of an `__init__` only what is no import and no `__all__`."""
    if not path.endswith("__init__.py"):
        return text
    passed_on = (ast.Import, ast.ImportFrom, ast.Assign)
    return "\n".join(ast.unparse(node) for node in ast.parse(text).body if not isinstance(node, passed_on))


def bare_constants(tree: ast.Module, text: str) -> Iterator[str]:
    """Constants of a module whose numbers nothing explains."""
    lines = text.splitlines()
    for node in tree.body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if not isinstance(target, ast.Name) or not target.id.isupper():
            continue
        numbers = [n for n in ast.walk(node) if isinstance(n, ast.Constant) and type(n.value) in (int, float)]
        own = lines[node.lineno - 1 : node.end_lineno]
        if numbers and not any("#" in x or "__file__" in x for x in own) and not lines[node.lineno - 2].startswith("#"):
            yield target.id


def hanging(text: str) -> list[int]:
    """Lines of a Python file with prose behind code."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    comments = (t for t in tokens if t.type == tokenize.COMMENT and t.line[: t.start[1]].strip())
    return [t.start[0] for t in comments if not NO_PROSE.match(t.string)]


def words(code: Files, trees: dict[str, ast.Module]) -> dict[str, float]:
    """Pronouns of 100 words in the heads of src's files, mean letters of a line, and decisions of 100 lines."""
    ours = {path: tree for path, tree in trees.items() if path.startswith("src/")}
    heads = " ".join(ast.get_docstring(tree) or "" for tree in ours.values())
    lines = [line for path in ours for line in code[path].splitlines()]
    full = [len(line) for line in lines if line.strip()]
    decisions = sum(complexity(tree) - 1 for tree in ours.values())
    return {
        "pronouns": round(100 * len(PRONOUNS.findall(heads)) / max(1, len(re.findall(r"\w+", heads))), 1),
        "letters a line": round(sum(full) / max(1, len(full)), 1),
        "decisions": round(100 * decisions / max(1, len(lines)), 1),
    }


def in_text(path: str, text: str) -> Iterator[tuple[str, str]]:
    """Kind and place of what is found in the text of a file of src, C or C in Python."""
    for kind, pattern in (("Newton loops", C_NEWTON), ("rollout drivers", C_ROLLOUT)):
        yield from ((kind, f"{path} {m.group().strip()}") for m in pattern.finditer(text))


def in_tree(path: str, text: str, tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Kind and place of what is found in the syntax of a file."""
    ours = path.startswith("src/")
    for f in (n for n in ast.walk(tree) if isinstance(n, FUNCTIONS)):
        place = f"{path}:{f.lineno} {f.name}"
        sizes = {"long functions": (length(f), LONG), "wide functions": (parameters(f), WIDE)}
        yield from ((kind, f"{place} {size}") for kind, (size, most) in sizes.items() if size > most)
        if ours and drives(f):
            yield "rollout drivers", place
    yield from (("bare constants", f"{path} {name}") for name in bare_constants(tree, text))
    yield from (("hanging comments", f"{path}:{line}") for line in (hanging(text) if ours else ()))
    if ours and room(path) != "training":
        yield from (("Newton loops", f"{path}:{loop}") for loop in newton_loops(tree, text))


def census(files: Files) -> dict[str, Any]:
    """Every count, and what was found."""
    code = {p: t for p, t in files.items() if not p.startswith("tests/") and p.endswith((".py", ".c", ".h"))}
    trees = {p: ast.parse(t) for p, t in code.items() if p.endswith(".py")}
    found = findings(code, trees) | {"circles": [" ↔ ".join(group) for group in circles(imports(code))]}
    found["uncalled names"] = uncalled(files)
    functions = ((p, f) for p, tree in trees.items() for f in ast.walk(tree) if isinstance(f, FUNCTIONS))
    most = max(((complexity(f), f"{p}:{f.lineno} {f.name}") for p, f in functions), default=(0, ""))
    counts = {"complexity": most[0], **{kind: len(x) for kind, x in found.items()}}
    lines = lines_of(code)
    lines["tests"] = sum(text.count("\n") for p, text in files.items() if p.startswith("tests/") and p.endswith(".py"))
    return {"lines": lines, "counts": counts | words(code, trees), "most complex": most[1], "found": found}


def findings(code: Files, trees: dict[str, ast.Module]) -> dict[str, list[str]]:
    """Places by kind, of all that is found file by file."""
    kinds = (
        "long functions",
        "wide functions",
        "Newton loops",
        "rollout drivers",
        "bare constants",
        "hanging comments",
    )
    found: dict[str, list[str]] = {kind: [] for kind in kinds}
    for path, text in code.items():
        pairs = list(in_text(path, text)) if path.startswith("src/") else []
        for kind, place in [*pairs, *(in_tree(path, text, trees[path]) if path in trees else ())]:
            found[kind].append(place)
    return found


def lines_of(code: Files) -> dict[str, int]:
    """Lines by budget, of src, and of all."""
    lines = Counter({path: text.count("\n") for path, text in code.items()})
    budget = {name: sum(lines[p] for p in code if room(p) in rooms) for name, (rooms, _) in BUDGETS.items()}
    return budget | {"src": sum(lines[p] for p in code if p.startswith("src/")), "outside tests": lines.total()}


def table(now: dict[str, Any], before: dict[str, Any] | None) -> str:
    """Counts as text, with those of another revision before them."""
    goals = {name: goal for name, (_, goal) in BUDGETS.items()} | GOALS
    rows = [f"{'':28}{'before' if before else '':>9}{'now':>8}{'goal':>9}"]
    for part in ("lines", "counts"):
        for name, value in now[part].items():
            goal = f"{goals[name]:,}" if name in goals else ""
            old = f"{before[part].get(name, 0):,} →" if before else ""
            over = "over" if name in goals and value > goals[name] else ""
            rows.append(f"{name:28}{old:>9}{value:>8,}{goal:>9}  {over}".rstrip())
    return "\n".join(rows)


def main(argv: list[str] | None = None) -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="REV", help="a revision to compare with, e.g. HEAD~20")
    parser.add_argument("--json", action="store_true", help="everything that was found, as JSON")
    parser.add_argument("--list", action="store_true", help="name every finding under the table")
    arguments = parser.parse_args(argv)
    now = census(sources(None))
    before = census(sources(arguments.against)) if arguments.against else None
    if arguments.json:
        print(json.dumps({"now": now, "before": before}, indent=1, ensure_ascii=False))
        return
    print(table(now, before))
    print(f"\nmost complex: {now['most complex']}")
    for kind, found in now["found"].items() if arguments.list else ():
        print("\n".join([f"\n{kind}:", *(f"  {one}" for one in found)]))


if __name__ == "__main__":
    main()
