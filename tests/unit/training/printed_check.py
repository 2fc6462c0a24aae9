"""The free run of a printed equation beside that of the model it was printed for."""

import numpy as np
import torch
from printed_motion import Printed, integrated

from herglotz.training.equation_notes import free_run, longest_step


def compared(run, text=None, parts=20):
    """RMS of the model from the data, and of the printed text from the model, over the balance of the coordinates."""
    data = run.data.unwrapped()
    inputs = [name for name, _ in data.input_labels] if run.model.inputs else []
    printed = Printed(str(run.equation()) if text is None else text, data.names, inputs)
    model, balance, missed, moved = free_run(run, longest_step(run)).numpy(), data.balance.numpy(), [], []
    for first, length in zip(data.offsets, data.lengths, strict=True):
        own = slice(first, first + length)
        q, p, s = (x[first : first + 1].detach().numpy() for x in run.states)
        u = inputs_at(data, first, inputs)
        moved.append(integrated(printed, data.t[None, own].numpy(), q, p, s, u, parts)[0] - model[own])
        missed.append(model[own] - data.q[own].numpy())
    return tuple(float(np.sqrt(np.mean((np.concatenate(x) / balance) ** 2))) for x in (missed, moved))


def inputs_at(data, first, names):
    """u(k, share) of the step k: as the data's hold has it between samples."""
    if not names:
        return lambda _k, _share: []

    def at(k, share):
        row = torch.tensor([first + k])
        return data.inputs_of_steps(row, torch.tensor([share], dtype=data.t.dtype)).numpy().T

    return at
