"""The free run of a printed equation beside that of the model it was printed for."""

import numpy as np
import torch
from printed_motion import Printed, integrated

from herglotz.training.equation import free_run, longest_step


def compared(run, text=None, parts=8):
    """RMS of the model from the data, and of the printed text from the model, over the balance of the coordinates."""
    data = run.data.unwrapped()
    inputs = [name for name, _ in data.input_labels] if run.model.inputs else []
    printed = Printed(str(run.equation()) if text is None else text, data.names, inputs)
    model, balance, missed, moved = free_run(run, longest_step(run)).numpy(), data.balance.numpy(), [], []
    groups = {}
    for b, length in enumerate(data.lengths):
        groups.setdefault(length, []).append(data.offsets[b])
    for length, firsts in groups.items():
        rows = np.array(firsts)[:, None] + np.arange(length)
        q, p, s = (x[rows[:, 0]].detach().numpy() for x in run.states)
        text_runs = integrated(printed, data.t.numpy()[rows], q, p, s, inputs_at(data, firsts, inputs), parts)
        moved.append((text_runs - model[rows]).reshape(-1, data.dof))
        missed.append((model[rows] - data.q.numpy()[rows]).reshape(-1, data.dof))
    return tuple(float(np.sqrt(np.mean((np.concatenate(x) / balance) ** 2))) for x in (missed, moved))


def inputs_at(data, firsts, names):
    """u(k, share), (m, B), of the step k: as the data's hold has it between samples."""

    def at(k, share):
        rows = torch.tensor(firsts) + k
        return data.inputs_of_steps(rows, torch.full((len(rows),), share, dtype=data.t.dtype)).numpy().T

    return at if names else lambda _k, _share: []
