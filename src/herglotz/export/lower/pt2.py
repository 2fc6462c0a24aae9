"""A model as one `.pt2` file that steps with PyTorch alone, without this package."""

from __future__ import annotations

import io
from typing import Any

from herglotz.data.files import sealed_zip
from herglotz.export.metadata import METADATA, to_json
from herglotz.export.programs import programs_of, quiet, writes
from herglotz.models import ContactLagrangian


@writes
def export_pt2(model: ContactLagrangian, entries: dict[str, Any]) -> bytes:
    """Write the model's flow as a `.pt2` file: graphs of tensor operations that any PyTorch of this version runs.

    The file holds five programs. `model`, which `torch.export.load(path).module()` loads on a machine without herglotz,
    is one step (q, p, s, h) → (q1, p1, s1, c, residual, status[, outside]), differentiable in the state; `rollout` is
    K steps with the loop over steps and Newton's loop inside; `linearise` is one step and its Jacobian; `init` is the
    start (q0, q1, s0, h) → (p1, s1); `legendre` is (q, v, s, h) → (L_v, L_vv). The batch size is free and every step
    h > 0 is accepted. A model with inputs takes u after h. With a box, outside is 1 where a step starts or ends outside
    the box, plus 2 where h is outside `h_range`.

    Parameters
    ----------
    model
        In float32 or float64, which becomes the dtype of the file; not changed.
    path
        The file to write, atomically; its name should end in `.pt2`.
    h
        Typical step of the model, in the data's time unit: recorded, not imposed.
    box
        The states that the model was fitted to: q_low, q_high, p_low, p_high (n numbers each), s_low, s_high (1 each),
        in the units of the model.
    units
        Unit of each coordinate.
    metadata
        Further entries, ready for JSON, under other names than those written here. With `h_range` = (low, high) the
        loaders refuse other steps, and the file flags them.
    newton_iterations
        Bound on the Newton iterations of a step, at least 2.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If h, box, units or metadata are not usable, or the file cannot be written.
    """
    with quiet():
        programs = programs_of(model, entries, ("model", "rollout", "linearise", "init", "legendre"))
        # torch.export.save calls package_pt2 for a single program.
        from torch.export.pt2_archive._package import package_pt2

        buffer = io.BytesIO()
        package_pt2(buffer, exported_programs=programs, extra_files={METADATA: to_json(entries)})
    return sealed_zip(buffer.getvalue())
