"""The rows of the judge, the most informative first, each with what makes its job. No torch here."""

from __future__ import annotations

from dataclasses import dataclass

# Seeds of the zoo that earlier work looked at.
KNOWN_DRAWS = (1, 4471, 4627, 8053, 8817)
# Seeds of the zoo for which nothing was changed.
FRESH_DRAWS = (2953, 6311, 9377)
# Seed of the open systems.
OPEN_DRAW = 5417
# Number of systems of a draw.
COUNT, OPEN_COUNT = 10, 12
CASES = (
    ("bilinear_damper", ("",)), ("closed_loop", ("", "_one", "_clean", "_dither", "_nod", "_tenth")),
    ("torsion_turns", ("", "_small", "_two")), ("furuta", ("", "_big")), ("base_road", ("", "_two")),
    ("mems_v2", ("", "_sq")), ("merged_rates", ("", "_filled")), ("naming", ("_current", "_motor", "_rate")),
    ("deg_nounit", ("",)), ("short_many", ("",)), ("tracker_xy", ("",)), ("never_moves", ("",)), ("quantised", ("",)),
    ("wrap4pi", ("", "_2pi", "_lost", "_resampled")),
)  # fmt: skip
MANY_DOF = (
    "double pendulum, hinges, nothing told", "double pendulum, hinges, 20 × 50", "double pendulum, hinges, 100 × 100",
    "double pendulum, one rate, 20 × 50", "Kepler, drag, nothing told", "charged particle, drag, nothing told",
    "Kepler, drag", "Kepler, drag, larger step", "Kepler, drag, larger step, 4 model steps",
    "chain of 10, nothing told", "chain of 10", "chain of 10, larger step",
    "chain of 10, larger step, 2 model steps", "chain of 32",
)  # fmt: skip
# A part of every kind: 5 minutes of processor time at most, their data and scores included.
QUICK = (
    "cases/bilinear_damper", "cases/closed_loop_one", "cases/torsion_turns_small", "cases/quantised", "demo",
    "measured/real_pendulum", "measured/air_track", "simulated/noise", "law 5 noisy", "law 6 exact", "open 5417/1",
    "zoo 4471/4", "zoo 2953/0", "many_dof/chain of 10", "peers/pendulum_05",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    name: str
    # Module of this package, and its function that writes the job into a folder.
    maker: str
    # Further arguments of the function.
    given: tuple[str | int | float, ...] = ()

    @property
    def folder(self) -> str:
        """A name for files."""
        return "".join(x if x.isalnum() or x in "._-" else "_" for x in self.name)


def rows(count: int = COUNT) -> list[Row]:
    """All rows; `count` systems of each draw of the zoo, and in the same proportion of the open zoo."""
    found = [Row(f"cases/{name}{train}", "recorded:case", (name, train)) for name, trains in CASES for train in trains]
    found += [
        Row("demo", "recorded:demo"),
        Row("select", "simulated:selected"),
        Row("measured/real_pendulum", "recorded:as_it_is", ("schmidt_lipson_2009/real_pend_h_1.txt", "rad")),
        Row("measured/air_track", "recorded:as_it_is", ("schmidt_lipson_2009/real_linear_h_1.txt", "m")),
        Row("measured/motor_axis", "recorded:motor_axis"),
        Row("measured/duffing_circuit", "recorded:duffing_circuit"),
        Row("measured/one_motor", "recorded:one_motor"),
        Row("measured/two_joints", "recorded:two_joints", (0,)),
        Row("measured/two_joints, all windows", "recorded:two_joints_whole"),
        Row("measured/two_motors, every 4th", "recorded:two_motors", (4,)),
        Row("measured/two_motors", "recorded:two_motors", (1,)),
        Row("measured/two_motors, all runs", "recorded:all_runs", ("two",)),
        Row("measured/one_motor, all runs", "recorded:all_runs", ("one",)),
        Row("simulated/noise", "simulated:noise", (40, 0)),
        Row("simulated/one_trajectory", "simulated:noise", (1, 0)),
        Row("simulated/outliers", "simulated:outliers", (0,)),
        Row("simulated/disturbed", "simulated:disturbed", (0,)),
        Row("simulated/twenty", "simulated:twenty"),
        Row("simulated/drive", "simulated:drive", (1.0, 0)),
        Row("simulated/drive with a gear", "simulated:drive", (0.2, 0)),
        Row("simulated/spring pendulum in mm", "simulated:spring_pendulum", (0,)),
    ]
    found += [
        Row(f"law {k} {word}", "drawn:law", (k, noise))
        for k in range(1, 7) for word, noise in (("exact", 0.0), ("noisy", 0.005))
    ]  # fmt: skip
    more = max(1, round(OPEN_COUNT * count / COUNT))
    found += [Row(f"open {OPEN_DRAW}/{i}", "drawn:drawn_open", (OPEN_DRAW, i)) for i in range(more)]
    # By index, then by draw: a run that is not done yet has some of every draw.
    found += [Row(f"zoo {d}/{i}", "drawn:known", (d, i)) for i in range(count) for d in (*FRESH_DRAWS, *KNOWN_DRAWS)]
    found += [Row(f"many_dof/{name}", "simulated:many_dof", (name, 0)) for name in MANY_DOF]
    found += [Row(f"many_dof/{name}", "simulated:one_rate", (name, 0)) for name in ("parachute", "quadratic_drag")]
    found += [
        Row(f"peers/pendulum_{word}", "simulated:pendulum", (h, noise, 0))
        for word, h, noise in (("02", 0.2, 0.0), ("05", 0.5, 0.0), ("10", 1.0, 0.0), ("noise", 0.2, 0.01))
    ]
    return [
        *found,
        Row("peers/pendulum_one", "simulated:one_pendulum", (0,)),
        Row("peers/double_pendulum", "simulated:double_pendulum", (0,)),
        Row("peers/ibm", "simulated:ibm"),
    ]


def named(name: str) -> Row:
    """The row of this name, in a zoo of any size."""
    kind, _, place = name.rpartition("/")
    maker = {"zoo": "drawn:known", "open": "drawn:drawn_open"}.get(kind.split(" ")[0])
    if maker is not None:
        return Row(name, maker, (int(kind.split(" ")[1]), int(place)))
    return next(row for row in rows() if row.name == name)
