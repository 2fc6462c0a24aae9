"""An animation of data and model: angles as links, two lengths as a point in the plane, other lengths as beads."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from herglotz.data import Trajectories
from herglotz.data.checks import check_trajectory
from herglotz.data.files import PathLike, write_atomically
from herglotz.data.units import as_recorded
from herglotz.errors import InputError
from herglotz.plots.motion import DATA
from herglotz.plots.style import DPI, INK, MODEL, MUTED, SHADE, UNSEEN, captions, new_figure, styled, with_unit
from herglotz.training import Run

# Six seconds, in a file below 1 MB.
FRAMES, FRAMES_PER_SECOND, COLOURS = 120, 20, 64
# More coordinates in one panel cannot be told apart.
MAX_COORDINATES = 3
# x and y of the joints, (points,) each.
Shape = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Animation:
    """A written GIF, which a notebook plays."""

    path: Path

    def _repr_html_(self) -> str:
        return f'<img alt="animation" src="data:image/gif;base64,{base64.b64encode(self.path.read_bytes()).decode()}">'


def save_animation(run: Run, path: PathLike, trajectory: int = 0) -> Animation:
    """Write a GIF of one trajectory: the recording in grey beside the model's free run, and both against time.

    If all coordinates are angles, links of equal length hang from a point, and each angle is measured from the
    vertical; angles after a length hang from a cart. Two lengths of the same unit are a point in the plane. Other
    lengths are beads side by side, each displaced by its coordinate. The animation lasts six seconds.

    Parameters
    ----------
    run
        The result of `fit`.
    path
        The file, which ends in .gif.
    trajectory
        Number of the trajectory in `run.data`, from 0.

    Returns
    -------
    Animation
        Has the `path`; as the last line of a notebook's cell, shows the GIF.

    Raises
    ------
    InputError
        If the name does not end in .gif, or the data have no such trajectory.
    """
    data = run.data.unwrapped()
    if Path(path).suffix.lower() != ".gif":
        raise InputError(f"{path}: an animation's name must end in .gif")
    check_trajectory(trajectory, len(data))
    rows = slice(data.offsets[trajectory], data.offsets[trajectory] + data.lengths[trajectory])
    t, q, model = (x[rows].detach().double().cpu().numpy() for x in (data.t, data.q, run.prediction))
    boundary = t[max(min(run.train_lengths[trajectory], len(t)) - 1, 0)]
    frames = np.linspace(t[0], t[-1], min(FRAMES, max(len(t), 2)))
    scene = _Scene(run, np.r_[q, model[np.isfinite(model).all(1)]])
    with styled():
        figure = new_figure(8.0, 3.6, f"{data.source or 'data'} and the model's free run")
        left, right = figure.subplots(1, 2, width_ratios=[1, 1.3])
        scene.frame(left)
        captions(left, [("data", "#777777"), ("fit", MODEL), ("free run", UNSEEN)])
        recorded = left.plot([], [], "o-", color=DATA, lw=3, ms=9)[0]
        moving = left.plot([], [], "o-", lw=1.4, ms=5)[0]
        shown, factor = as_recorded(data)
        by = factor.cpu().numpy()
        cursor = _series(right, shown, (t, q * by, model * by), boundary)
        figure.set_dpi(DPI // 2)
        artists = (recorded, moving, cursor)
        for artist in artists:
            artist.set_animated(True)
        canvas, images = FigureCanvasAgg(figure), []
        canvas.draw()
        # The background, all but the animated artists, is drawn once.
        background = canvas.copy_from_bbox(figure.bbox)
        for time in frames:
            recorded.set_data(*scene.shape(_at(time, t, q)))
            moving.set_data(*scene.shape(_at(time, t, model)))
            moving.set_color(MODEL if time <= boundary else UNSEEN)
            cursor.set_xdata([time, time])
            canvas.restore_region(background)
            for ax, artist in zip((left, left, right), artists, strict=True):
                ax.draw_artist(artist)
            images.append(Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB").quantize(COLOURS))
    gif = io.BytesIO()
    images[0].save(gif, "GIF", save_all=True, append_images=images[1:], duration=1000 // FRAMES_PER_SECOND, loop=0)
    write_atomically(path, gif.getvalue())
    return Animation(Path(path))


def _at(time: float, t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Positions (n,) at a time, interpolated between samples."""
    return np.array([np.interp(time, t, column) for column in q.T])


def _series(ax: Axes, data: Trajectories, motion: tuple[np.ndarray, np.ndarray, np.ndarray], boundary: float):
    """Draw the coordinates against time; return the line that marks the present time."""
    (t, q, model), seen = motion, motion[0] <= boundary
    for i in range(min(q.shape[1], MAX_COORDINATES)):
        ax.plot(t, q[:, i], ".", color=DATA, ms=5)
        ax.plot(t[seen], model[seen, i], color=MODEL, lw=1)
        ax.plot(t[t >= boundary], model[t >= boundary, i], color=UNSEEN, lw=1)
    if boundary < t[-1]:
        ax.axvspan(boundary, t[-1], color=SHADE, lw=0, zorder=0)
    ax.set(xlim=(t[0], t[-1]), xlabel=with_unit("time", data.time_unit))
    names = data.names[:MAX_COORDINATES]
    ax.set_ylabel(", ".join(with_unit(name, unit) for name, unit in zip(names, data.units, strict=False)))
    return ax.axvline(t[0], color=INK, lw=1)


class _Scene:
    """How a position is drawn: as links, as a point in the plane, or as beads."""

    def __init__(self, run: Run, positions: np.ndarray):
        angles, n = run.data.angles, run.data.dof
        self.plane = n == 2 and not any(angles) and len(set(run.data.units)) == 1
        self.links = n if all(angles) else n - 1 if n > 1 and not angles[0] and all(angles[1:]) else 0
        reach = positions[:, 0] if self.links < n and self.links else np.zeros(1)
        self.length = 1.0 if self.links == n else 0.5 * max(float(np.ptp(reach)), 1e-12)
        shapes = [self.shape(row) for row in positions[:: max(len(positions) // 200, 1)]]
        x, y = (np.concatenate(part) for part in zip(*shapes, strict=True))
        room = 0.12 * max(float(np.ptp(x)), float(np.ptp(y)), 1e-12)
        self.x, self.y = (x.min() - room, x.max() + room), (y.min() - room, y.max() + 2.5 * room)

    def shape(self, q: np.ndarray) -> Shape:
        """Joints of a position (n,)."""
        if self.links:
            own = q[len(q) - self.links :]
            base = 0.0 if self.links == len(q) else q[0]
            x, y = self.length * np.sin(own).cumsum(), -self.length * np.cos(own).cumsum()
            return np.r_[base, base + x], np.r_[0.0, y]
        if self.plane:
            return q[:1], q[1:]
        return (q, np.zeros(1)) if len(q) == 1 else (np.arange(len(q)) * 1.0, q)

    def frame(self, ax: Axes) -> None:
        """Set the limits and draw the parts that do not move."""
        ax.set(xlim=self.x, ylim=self.y)
        if self.links or self.plane:
            ax.set_aspect("equal")
        if self.links:
            ax.plot(*((0.0, 0.0) if self.length == 1.0 else (self.x, (0.0, 0.0))), color=MUTED, marker="+", lw=0.8)
        elif not self.plane:
            ax.axhline(0.0, color=MUTED, lw=0.8)
        ax.tick_params(labelsize=8)
