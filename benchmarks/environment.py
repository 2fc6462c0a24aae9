"""Environment steps a second beside MuJoCo's: `python benchmarks/environment.py [--quick] [--out FOLDER]`.

A pendulum and a cart with a pole are simulated by MuJoCo (RK4, steps of 1 ms), their motion under random inputs is
recorded with noise and fitted, and `hz.VectorEnv` of the fit is stepped against MuJoCo itself. An environment step is
20 ms; the fit says how many steps of the model that is, and MuJoCo takes the same steps.

Ours is the whole environment: steps in C, velocities, reward, checks, observations and resets. MuJoCo's is its physics
alone, without contacts, constraints and a reward, by the faster of its two batches, `mujoco.rollout` and
`mujoco.batch`, and with two integrators: its default (semi-implicit Euler, order 1) and RK4. Both have one thread and
the same inputs, new ones each step; what is compared is timed in turn within each repeat, in processor time.

Needs mujoco and gymnasium: `pip install 'herglotz[gymnasium]' mujoco`. Writes environment.json and environment.md.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import herglotz as hz
from benchmarks import harness
from benchmarks.harness import seconds

H = 0.02  # of an environment step, in s
FINE = 0.001  # step of the recorded motion, in s
NOISE = 5e-3  # of recorded positions, in m and rad
BATCHES = {1: 1000, 64: 200, 4096: 16}  # number of environments: steps of a repeat, of some 10 to 100 ms
OPTION = (
    '<mujoco><option timestep="{h}" integrator="{integrator}"><flag contact="disable" constraint="disable"/></option>'
)
SYSTEMS = {
    "pendulum": """<worldbody><body><joint name="theta" type="hinge" axis="0 1 0" damping="0.1"/>
      <inertial pos="0 0 -0.5" mass="1" diaginertia="0.02 0.02 0.02"/></body></worldbody>
      <actuator><motor joint="theta"/></actuator></mujoco>""",
    "cart-pole": """<worldbody><body><joint name="x" type="slide" axis="1 0 0" damping="0.2"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/><body><joint name="theta" type="hinge" axis="0 1 0"
      damping="0.01"/><inertial pos="0 0 -0.5" mass="0.3" diaginertia="0.002 0.002 0.002"/></body></body></worldbody>
      <actuator><motor joint="x"/></actuator></mujoco>""",
}
COORDINATES = {"pendulum": ("theta[rad]",), "cart-pole": ("x[m]", "theta[rad]")}
FORCE = {"pendulum": 3.0, "cart-pole": 6.0}  # largest input of the motor
Row = dict[str, Any]


def model_of(mujoco: Any, system: str, h: float, integrator: str) -> Any:
    return mujoco.MjModel.from_xml_string(OPTION.format(h=h, integrator=integrator) + SYSTEMS[system])


def motion(mujoco: Any, system: str, h: float, integrator: str, start: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Positions (K + 1, n) at multiples of H under inputs that are held for H."""
    model = model_of(mujoco, system, h, integrator)
    data, found = mujoco.MjData(model), [start]
    data.qpos[:] = start
    for u in inputs:
        data.ctrl[:] = u
        mujoco.mj_step(model, data, round(H / h))
        found.append(data.qpos.copy())
    return np.array(found)


def recordings(mujoco: Any, system: str) -> list[dict[str, np.ndarray]]:
    """Four recordings of 4 s under a force that changes every 0.2 s."""
    draw, found = np.random.default_rng(0), []
    for start in (0.5, 2.0, -2.8, -1.5):
        q = np.zeros(len(COORDINATES[system]))
        q[-1] = start
        u = FORCE[system] * draw.uniform(-1, 1, 20).repeat(10)
        path = motion(mujoco, system, FINE, "RK4", q, u)
        path += NOISE * draw.normal(size=path.shape)
        columns = dict(zip(COORDINATES[system], path.T, strict=True))
        found.append({"t[s]": H * np.arange(201), **columns, "force[N]": np.r_[u, u[-1]]})
    return found


def environment(run: hz.Run, count: int) -> Any:
    """The fit as `count` environments, with a quadratic cost; episodes of 200 actions."""
    last = run.model.config.dof - 1

    def reward(q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        return -(q[:, last] ** 2) - 0.1 * v[:, last] ** 2 - 0.001 * u[:, 0] ** 2

    def reset(generator: np.random.Generator, rows: int) -> tuple[np.ndarray, np.ndarray]:
        return generator.uniform(-0.1, 0.1, (rows, last + 1)), np.zeros((rows, last + 1))

    made = hz.VectorEnv(run, count, reward=reward, reset=reset, h=run.h, steps_per_action=round(H / run.h),
                        max_episode_steps=200)  # fmt: skip
    made.reset(seed=0)
    return made


def mujoco_ways(
    mujoco: Any, system: str, integrator: str, h: float, count: int
) -> dict[str, Callable[[np.ndarray], Any]]:
    """H of `count` simulations in steps of h on this thread, by each of MuJoCo's batches."""
    from mujoco import rollout  # pyright: ignore[reportMissingImports]

    model, parts = model_of(mujoco, system, h, integrator), round(H / h)
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state, sensors = np.zeros((count, parts, size)), np.zeros((count, parts, 0))
    state[:, -1, model.nq] = 0.1
    pool, data, models = rollout.Rollout(nthread=0), [mujoco.MjData(model)], [model] * count

    def by_rollout(u: np.ndarray) -> None:
        held = {"control": u[:, None].repeat(parts, 1), "nstep": parts}
        pool.rollout(models, data, state[:, -1].copy(), **held, state=state, sensordata=sensors, skip_checks=True)

    ways: dict[str, Callable[[np.ndarray], Any]] = {"mujoco.rollout": by_rollout}
    try:
        from mujoco.batch import Batch  # pyright: ignore[reportMissingImports]
    except ImportError:  # before MuJoCo 4
        return ways
    batch = Batch(model, count, nthread=1)
    control = batch.bind("ctrl")

    def by_batch(u: np.ndarray) -> None:
        control[:] = u
        batch.step(nstep=parts)

    return ways | {"mujoco.batch": by_batch}


def errors(mujoco: Any, system: str, run: hz.Run) -> Row:
    """Root mean square of the error of the last coordinate over 2 s under inputs of another draw, in rad."""
    u = FORCE[system] * np.random.default_rng(1).uniform(-1, 1, 10).repeat(10)
    start = np.zeros(len(COORDINATES[system]))
    start[-1] = 1.0
    exact = motion(mujoco, system, FINE, "RK4", start, u)
    parts = round(H / run.h)
    ours = run.rollout(100 * parts, q0=start, v0=0 * start, inputs=u.repeat(parts)[:, None], h=run.h).q[::parts]
    found = {"ours": ours} | {name: motion(mujoco, system, run.h, name, start, u) for name in ("Euler", "RK4")}
    return {name: float(np.sqrt(np.mean((q - exact)[:, -1] ** 2))) for name, q in found.items()}


def compared(mujoco: Any, system: str, run: hz.Run, count: int, quick: bool) -> list[Row]:
    """Nanoseconds an environment step, ours and MuJoCo's, and their ratios within each repeat."""
    env, draw = environment(run, count), np.random.default_rng(2)
    inputs = FORCE[system] * draw.uniform(-1, 1, (16, count, 1))
    steps = BATCHES[count] // (4 if quick else 1)
    found = []
    for integrator in ("Euler", "RK4"):
        calls = {"ours": env.step} | mujoco_ways(mujoco, system, integrator, run.h, count)

        def many(call: Callable[[np.ndarray], Any], steps: int = steps) -> None:
            for k in range(steps):
                call(inputs[k % 16])

        repeats = [{name: seconds(lambda c=call: many(c)) / steps / count for name, call in calls.items()}
                   for _ in range(4 if quick else 10)][1:]  # fmt: skip
        way = min((x for x in calls if x != "ours"), key=lambda x: statistics.median(one[x] for one in repeats))
        ratios = [one[way] / one["ours"] for one in repeats]
        found.append({
            "system": system, "batch": count, "integrator": integrator, "way": way,
            "ours_ns": 1e9 * statistics.median(one["ours"] for one in repeats),
            "mujoco_ns": 1e9 * statistics.median(one[way] for one in repeats),
            "ratio": {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios)},
        })  # fmt: skip
    return found


def table(found: Row) -> str:
    """Markdown: speed, then errors."""
    rows = [
        [r["system"], r["batch"], f"{r['ours_ns']:.3g}", f"{r['mujoco_ns']:.3g}", f"{r['integrator']}, {r['way']}",
         f"{r['ratio']['median']:.3g}×", f"{r['ratio']['min']:.3g} … {r['ratio']['max']:.3g}"]
        for r in found["rows"]
    ]  # fmt: skip
    head = ("system", "B", "ours, ns a step", "MuJoCo, ns a step", "by", "ratio", "range")
    lines = [*harness.table(head, rows), ""]
    head = ("system", "ours, rad", "MuJoCo Euler, rad", "MuJoCo RK4, rad", "step of all, s")
    keys = ("ours", "Euler", "RK4", "h")
    rows = [[name, *(f"{one[key]:.2g}" for key in keys)] for name, one in found["errors"].items()]
    return "\n".join([*lines, *harness.table(head, rows)])


def main(argv: list[str] | None = None) -> None:
    arguments = harness.parser(__doc__, quick=True).parse_args(argv)
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError:
        sys.exit("benchmarks/environment.py needs mujoco; install it: pip install mujoco")
    path = harness.json_file(arguments, "environment")
    found: Row = harness.conditions("mujoco", "gymnasium", "numpy") | {"h": H, "errors": {}, "rows": []}
    for system in SYSTEMS:
        run = hz.fit(recordings(mujoco, system), progress=False)
        verdict = run.metrics["verdict"].split(":")[0]
        found["errors"][system] = errors(mujoco, system, run) | {"h": run.h, "verdict": verdict}
        for count in BATCHES:
            found["rows"] += compared(mujoco, system, run, count, arguments.quick)
            harness.store(path, found, table(found))
    print(table(found))


if __name__ == "__main__":
    main()
