"""The exported step in control: `python benchmarks/control.py [--quick] [--only PART ...] [--out FOLDER]`.

`nlp`: the swing-up of `examples/mpc_swing_up.py` by IPOPT over 50 intervals of 0.05 s, each of 8 steps; the same step
as the file for CasADi (the horizon in one call) and as CasADi's own expressions. `l4casadi`: the same by L4CasADi,
where it is installed (`control_l4casadi.py` says how). `loop`: a real-time iteration in closed loop
(`control_loop.py`). One thread, processor time; what is compared is timed in turn within each repeat, and a ratio is
one of a single repeat. Writes control.json and control.md.
"""

from __future__ import annotations

import ctypes
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.control_loop import (
    FORCE,
    FORCE_WEIGHT,
    INTERVAL,
    LAST,
    STEPS,
    TRACK,
    UPRIGHT,
    WEIGHT,
    N,
    from_random_starts,
)  # fmt: skip
from benchmarks.control_model import H, model, sx_steps
from herglotz.codegen.c_compiler import compiler
from herglotz.export import export_casadi

NEAR = 0.1  # rad from upright
FLAGS = ("-O3", "-march=native", "-fPIC", "-shared")
Row = dict[str, Any]


def built(source: Path, *more: str) -> Path:
    """A C file as a library beside it."""
    library = source.with_suffix(".so")
    subprocess.run([*compiler(), *FLAGS, *more, str(source), "-o", str(library), "-lm"], check=True)
    return library


def repeated(step: ca.Function) -> ca.Function:
    """(x, u) → x after an interval, by single steps; of N columns."""
    x, u = ca.MX.sym("x", 5), ca.MX.sym("u")
    end = x
    for _ in range(STEPS):
        end = step(end, u, H)
    return ca.Function("ahead", [x, u], [end]).map(N)


def problem(ahead: ca.Function, **options: Any) -> tuple[dict[str, ca.MX], dict[str, Any]]:
    """The problem of optimal control, and the solver's options: the Hessian is that of the cost."""
    X, U, start = ca.MX.sym("X", 5, N + 1), ca.MX.sym("U", 1, N), ca.MX.sym("start", 5)
    distance = ca.DM(WEIGHT).T @ (X - UPRIGHT) ** 2
    cost = ca.sum2(distance) + LAST * distance[-1] + FORCE_WEIGHT * ca.sumsqr(U)
    unknowns = ca.veccat(X, U)
    gaps = ca.veccat(X[:, 0] - start, ahead(X[:, :-1], U) - X[:, 1:])
    scale, multipliers = ca.MX.sym("scale"), ca.MX.sym("multipliers", gaps.shape[0])
    hessian = ca.triu(scale * ca.hessian(cost, unknowns)[0])
    options["hess_lag"] = ca.Function("hess_lag", [unknowns, start, scale, multipliers], [hessian])
    options |= {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-4}, "print_time": False}
    return {"x": unknowns, "f": cost, "g": gaps, "p": start}, options


def solver(ahead: ca.Function) -> ca.Function:
    """IPOPT on the problem with this interval."""
    nlp, options = problem(ahead)
    return ca.nlpsol("solver", "ipopt", nlp, options)


def generated(ahead: ca.Function, path: Path) -> ca.Function:
    """The same with cost, gaps and their derivatives in C that CasADi generates."""
    source = Path(solver(ahead).generate_dependencies(path.name))
    source = source.rename(path) if source.resolve() != path.resolve() else path
    own = {name: ca.external(f"nlp{name}", str(built(source))) for name in ("", "_grad_f", "_jac_g")}
    _, options = problem(ahead, grad_f=own["_grad_f"], jac_g=own["_jac_g"])
    return ca.nlpsol("solver", "ipopt", own[""], options)


def solve(solver: ca.Function) -> tuple[float, float, float]:
    """Seconds of processor time, those in the problem's functions, and the least cost."""
    bound = np.full((5, N + 1), np.inf)
    bound[0] = TRACK
    bound = np.concatenate([bound.ravel("F"), np.full(N, FORCE)])
    guess = np.concatenate([np.linspace(np.zeros(5), UPRIGHT, N + 1).ravel(), np.full(N, 0.1)])
    began = time.process_time()
    found = solver(x0=guess, p=np.zeros(5), lbx=-bound, ubx=bound, lbg=0, ubg=0)
    took, stats = time.process_time() - began, solver.stats()
    assert stats["success"], stats["return_status"]
    return took, sum(x for key, x in stats.items() if key.startswith("t_proc_nlp")), float(found["f"])


def exported(folder: Path) -> tuple[str, ca.Function]:
    """The compiled file for CasADi, and all intervals by its one call."""
    library = str(built(export_casadi(model(), folder / "cart.c", h=H), f"-Dcart_HORIZON={N}"))
    shoot, X, U = ca.external("cart_shoot", library), ca.MX.sym("X", 5, N), ca.MX.sym("U", 1, N)
    return library, ca.Function("ahead", [X, U], [shoot(X, U, INTERVAL)])


def nlp(quick: bool, folder: Path) -> list[Row]:
    """The whole solution and its functions, ours and others in turn."""
    library, shoot = exported(folder)
    hold, x, u = ca.external("cart_hold", library), ca.MX.sym("x", 5), ca.MX.sym("u")
    own = sx_steps()
    forms = {
        "ours": solver(shoot),
        "ours, 50 calls of a hold": solver(ca.Function("ahead", [x, u], [hold(x, u, INTERVAL)]).map(N)),
        "ours, 8 calls of a step": solver(repeated(ca.external("cart_step", library))),
        "SX, fast_newton": solver(repeated(own["rootfinder"])),
        "SX, Newton unrolled": solver(repeated(own["unrolled"])),
        "C of SX, fast_newton": generated(repeated(own["rootfinder"]), folder / "found.c"),
        "C of SX, Newton unrolled": generated(repeated(own["unrolled"]), folder / "unrolled.c"),
    }
    taken = [{name: solve(form) for name, form in forms.items()} for _ in range(1 if quick else 5)]
    costs = [cost for once in taken for _, _, cost in once.values()]
    assert max(costs) - min(costs) < 1e-6 * max(costs), costs  # the same problem
    rows = []
    for name in forms:
        whole, inside = ([once[name][k] / once["ours"][k] for once in taken] for k in (0, 1))
        row = {"what": f"swing-up, {name}", "ms": 1e3 * statistics.median(once[name][0] for once in taken)}
        target = None if name.startswith("ours") else 1.5 if name.startswith("C of") else 5.0
        rows.append(row | {"whole": whole, "functions": inside, "target": target})
    return rows


def l4casadi(quick: bool, folder: Path) -> list[Row]:
    """What all gaps and their Jacobian take, over ours, and what IPOPT makes of them."""
    from benchmarks.control_l4casadi import interval

    calls, at = [], np.concatenate([np.linspace(np.zeros(5), UPRIGHT, N + 1).ravel(), np.full(N, 0.1)])
    forms = (exported(folder)[1], interval(N, STEPS, folder))
    for ahead in forms:
        of = problem(ahead)[0]
        calls.append(ca.Function("both", [of["x"], of["p"]], [of["g"], ca.jacobian(of["g"], of["x"])]))
    (ours, slopes), (theirs, others) = ([np.array(ca.densify(x)) for x in call(at, np.zeros(5))] for call in calls)
    apart = max(float(abs(ours - theirs).max()), float(abs(slopes - others).max() / abs(slopes).max()))
    assert apart < 1e-3, apart  # the same functions, in float32
    ratios, ms = [], []
    for k in range(15 if quick else 50):
        taken = []
        for call, count in zip(calls, (20, 2), strict=True):
            began = time.process_time()
            for _ in range(count):
                call(at, np.zeros(5))
            taken.append((time.process_time() - began) / count)
        if k >= 10:  # TorchScript compiles in the first calls
            ratios.append(taken[1] / taken[0])
            ms.append(1e3 * taken[1])
    of, options = problem(forms[1])
    options["ipopt"] |= {"max_iter": 500}
    solved = ca.nlpsol("solver", "ipopt", of, options)
    with suppress(AssertionError):
        solve(solved)
    stats = solved.stats()
    inside = sum(x for key, x in stats.items() if key.startswith("t_proc_nlp"))
    note = f"{statistics.median(ms):.1f} ms; {min(ratios):.0f} to {max(ratios):.0f}"
    ended = f"{stats['return_status']}, at a tolerance of 1e-4 in float32; functions took {inside:.1f} s"
    what = "gaps of the swing-up with their Jacobian, L4CasADi over ours"
    return [
        {"what": what, "value": statistics.median(ratios), "target": ">= 10", "note": note},
        {"what": "iterations of IPOPT on L4CasADi's", "value": stats["iter_count"], "note": ended},
    ]


def loop(quick: bool, folder: Path) -> list[Row]:
    """From random starts: up for 10 s after at most 5 s, and the time of an iteration."""
    export_casadi(model(), folder / "model.c", h=H, name="model")
    source = folder / "rti.c"
    source.write_text((harness.ROOT / "examples" / "real_time_iteration" / "rti.c").read_text(encoding="utf-8"))
    found = from_random_starts(ctypes.CDLL(str(built(source))), 1 if quick else 100, round(15.0 / INTERVAL))
    off = [abs((one["angles"] % (2 * np.pi)) - np.pi) for one in found]
    last = [np.flatnonzero(x >= NEAR)[-1] + 1 if (x >= NEAR).any() else 0 for x in off]  # samples until it stays up
    up = sum(int(INTERVAL * k <= 5.0) for k in last)
    ms = np.concatenate([one["ms"] for one in found])
    return [
        {"what": f"up for 10 s, of {len(found)} random starts", "value": up, "target": f"{len(found)}"},
        {"what": "last time not within 0.1 rad of upright, s", "value": INTERVAL * max(last)},
        {"what": "farthest from upright in the last 10 s, rad", "value": float(max(x[-200:].max() for x in off))},
        {"what": "widest way of the cart, m", "value": max(one["widest"] for one in found), "target": f"<= {TRACK:g}"},
        {"what": "iterations before the first sample, at most", "value": max(one["first"] for one in found)},
        {"what": "an iteration, ms (median; clock)", "value": float(np.median(ms.sum(1))), "target": "<= 1"},
        {"what": "of it the feedback, ms (median; clock)", "value": float(np.median(ms[:, 1]))},
        {"what": "an iteration, ms (99 of 100; clock)", "value": float(np.quantile(ms.sum(1), 0.99))},
    ]


PARTS = {"nlp": nlp, "l4casadi": l4casadi, "loop": loop}


def table(rows: list[Row]) -> str:
    """Markdown: the solutions, then single numbers."""
    solved, other = [r for r in rows if "whole" in r], [r for r in rows if "whole" not in r]
    text = []
    if solved:
        span = lambda x: f"{statistics.median(x):.2f}× ({min(x):.2f} … {max(x):.2f})"  # noqa: E731
        cells = [(r["what"], f"{r['ms']:.0f}", span(r["whole"]), span(r["functions"]),
                  "" if r["target"] is None else f">= {r['target']:g}") for r in solved]  # fmt: skip
        head = ("what", "ms a solution", "over ours", "functions alone, over ours", "target")
        text += [*harness.table(head, cells), ""]
    cells = [(r["what"], f"{r['value']:.3g}", r.get("target", ""), r.get("note", "")) for r in other]
    return "\n".join([*text, *(harness.table(("what", "measured", "target", ""), cells) if cells else [])])


def main(argv: list[str] | None = None) -> None:
    """Measure the parts, and write both files."""
    parser = harness.parser(__doc__, quick=True)
    parser.add_argument("--only", nargs="*", choices=list(PARTS), help="parts to run")
    arguments = parser.parse_args(argv)
    path = harness.json_file(arguments, "control")
    parts = harness.load(path, {"parts": {}})["parts"]
    for name in arguments.only or PARTS:
        if name == "l4casadi" and find_spec(name) is None:
            print("l4casadi is not installed: its rows are those of the last run with it")
            continue
        with tempfile.TemporaryDirectory(prefix="herglotz-bench-") as folder:
            parts[name] = PARTS[name](arguments.quick, Path(folder))
        rows = [row for part in PARTS for row in parts.get(part, [])]
        harness.store(path, {**harness.conditions("casadi"), "parts": parts}, table(rows))
    print(path.with_suffix(".md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
