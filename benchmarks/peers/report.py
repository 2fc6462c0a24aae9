"""The table and the figure of the peers, from what their JSON holds."""

from __future__ import annotations

import statistics
import textwrap
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from benchmarks.harness import picture, spread, table as lines_of
from herglotz.plots.style import INK, MODEL, MUTED, UNSEEN, new_figure, styled

from . import PEERS
from .problems import PROBLEMS

Cell = dict[str, Any]
Rows = dict[tuple[str, str], list[Cell]]  # (peer, given) → its seeds
GIVEN = {"positions": "positions", "differences": "differences", "exact": "exact velocities"}


def rows_of(cells: dict[str, Cell], data: str) -> Rows:
    """The cells of one data set, by peer and by what it was given, in the order of `PEERS`."""
    rows: Rows = {}
    for key, cell in cells.items():
        name, peer, given, _ = key.split("/")
        if name == data:
            rows.setdefault((peer, given), []).append(cell)
    order = list(PEERS)
    return dict(sorted(rows.items(), key=lambda item: (list(GIVEN).index(item[0][1]) == 2, order.index(item[0][0]))))


def values(cells: list[Cell], name: str) -> list[float]:
    """What was measured of `name`, over the seeds that have it."""
    return [x for cell in cells if (x := cell.get(name)) is not None]


def table(result: dict[str, Any]) -> str:
    """Markdown: one table a data set."""
    s, m = result["settings"], result["machine"]
    lines = [
        "# herglotz beside its peers",
        "",
        "`python benchmarks/peers`. Every network peer: two hidden layers of "
        f"{s['width']} units, float64, Adam (rate {s['learning_rate']:g}, cosine, batches of {s['batch']}) for "
        f"{s['adam_part']:.0%} of {s['budget_s']:g} s of processor time, then L-BFGS; the weights of the least "
        "validation error are kept. "
        f"One thread of {m['processor']}, {m['cores']} cores. Versions: "
        + ", ".join(f"{k} {v}" for k, v in result["versions"].items())
        + ".",
        "",
        "Given: *positions*; *differences*, velocities made from the positions by five-point differences, because the "
        "method is defined by velocities; *exact velocities* (and momenta and their rates), which data seldom have. "
        "Without exact velocities every model starts from two positions (measured data: from the start that fits the "
        "samples before best). Error: rad, against the motion without noise where there is one. RMS: rollouts that "
        "end; failed: not finite or 50 rad off. Energy: RMS error of the energy along rollouts over its start "
        "(measured pendulum: error of the amplitude at the end). Median of the seeds (least – largest).",
        "",
        *lines_of(("peer", "what it is"), ((p.title, p.source) for p in PEERS.values())),
        "",
    ]
    for data in PROBLEMS:
        if rows := rows_of(result["cells"], data):
            lines += [f"## {data}", "", result["titles"][data] + ".", "", *_errors(rows), *_ahead(rows), ""]
    return "\n".join(lines)


def _errors(rows: Rows) -> list[str]:
    """A row a peer and what it was given."""
    found = []
    for (peer, given), cells in rows.items():
        failed, total = (sum(int(c.get(k) or 0) for c in cells) for k in ("failures", "rollouts"))
        stopped = [c["error"] for c in cells if c.get("error")]
        note = f"{failed} of {total}" + (f"; {len(stopped)} fits: {stopped[0]}" if stopped else "")
        seconds, parameters, decay = (values(cells, k) for k in ("seconds", "parameters", "decay"))
        found.append([
            PEERS[peer].title, GIVEN[given], spread(values(cells, "rms")), spread(values(cells, "median")), note,
            spread(decay) if decay else "–", f"{statistics.median(seconds):.0f}",
            round(statistics.median(parameters)) if parameters else "–", len(cells),
        ])  # fmt: skip
    head = ("peer", "given", "RMS", "median error", "failed", "energy", "training s", "parameters", "seeds")
    return lines_of(head, found)


def _ahead(rows: Rows) -> list[str]:
    """Errors of both angles after some times, where the data set asks for them."""
    ahead = {peer: c for (peer, _), c in rows.items() if any(x.get("after") for x in c)}
    if not ahead:
        return []
    times = next(x["after"] for c in ahead.values() for x in c if x.get("after"))
    found = []
    for peer, cells in ahead.items():
        reached = [x["after"] for x in cells if x.get("after")]
        found.append([PEERS[peer].title, *(_middle([after[t] for after in reached if after[t]]) for t in times)])
    words = "RMS of the elbow and the tip angle (rad), median of the seeds:"
    return ["", words, "", *lines_of(["peer", *(f"after {t}" for t in times)], found)]


def _middle(pairs: list[list[float]]) -> str:
    """Medians of both angles' errors."""
    columns = zip(*pairs, strict=True)
    return ", ".join(f"{statistics.median(column):.3f}" for column in columns) or "failed"


def draw(result: dict[str, Any], path: Path) -> None:
    """RMS of every seed, a panel a data set: filled where positions only were given."""
    shown = [data for data in PROBLEMS if rows_of(result["cells"], data)]
    peers = [p for p in PEERS if any(key.split("/")[1] == p for key in result["cells"])]
    place = {p: len(peers) - 1 - k for k, p in enumerate(peers)}
    if not shown:
        return
    columns = min(4, len(shown))
    lines = -(-len(shown) // columns)
    with styled():
        width, height = 2.6 + 2.5 * columns, 0.9 + (1.0 + 0.27 * len(peers)) * lines
        title = "Error of rollouts from unseen starts: RMS (rad) of every seed, and the median seed"
        figure = new_figure(width, height, title)
        top = {"rect": (0.0, 0.0, 1.0, 1.0 - 0.32 / height)}  # room for the key under the title
        figure.set_layout_engine("constrained", **top)
        axes = figure.subplots(lines, columns, squeeze=False, sharey=True)
        for ax in list(axes.flat)[len(shown) :]:
            ax.set_visible(False)
        for ax, data in zip(axes.flat, shown, strict=False):
            _panel(ax, result, data, place)
        key = [("● positions only, or differences of them", INK), ("○ exact velocities given", UNSEEN)]
        key.append(("× most rollouts failed", INK))
        for k, (text, color) in enumerate([("● herglotz, positions only", MODEL), *key]):
            left = (0.1, 2.2, 5.2, 7.2)[k] / width
            figure.text(left, 1 - 0.42 / height, text, color=color, fontsize=9)
        picture(figure, path)


def _panel(ax: Axes, result: dict[str, Any], data: str, place: dict[str, int]) -> None:
    """One data set: a row a peer, a mark a seed."""
    for (peer, given), cells in rows_of(result["cells"], data).items():
        exact, found = given == "exact", values(cells, "rms")
        color = MODEL if peer.startswith("ours") else UNSEEN if exact else INK
        y = place[peer] + {"exact": -0.2, "differences": 0.12}.get(given, 0.12 * (PEERS[peer].needs == "either"))
        failed, total = (sum(int(c.get(k) or 0) for c in cells) for k in ("failures", "rollouts"))
        style: dict[str, Any] = {"ms": 4, "mec": color, "mfc": "white" if exact else color, "clip_on": False}
        if found:  # an empty line that is not clipped would lie at the figure's corner, and stretch the layout
            ax.plot(found, [y] * len(found), "x" if 2 * failed > total else "o", **style)
            ax.plot([statistics.median(found)] * 2, [y - 0.2, y + 0.2], color=color, lw=1.6)
        else:
            ax.text(0.99, y, "failed", transform=ax.get_yaxis_transform(), ha="right", va="center", fontsize=7.5,
                    color=color if exact else MUTED, in_layout=False)  # fmt: skip
    words = result["titles"].get(data, data).split(";")[0].replace(" = ", "\u00a0=\u00a0")
    ax.set_title(textwrap.fill(words, 38), fontsize=8)
    ax.set(xscale="log", xlabel="RMS (rad)", ylim=(-0.7, len(place) - 0.4))
    low, high = ax.get_xlim()
    ax.set_xlim(low, high * (high / low) ** 0.03)
    ax.set_yticks(list(place.values()), [PEERS[p].title for p in place])
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="both", color="#EEEEEE", lw=0.8)
    for text in ax.get_yticklabels():
        text.set_color(MODEL if text.get_text().startswith("herglotz") else INK)
