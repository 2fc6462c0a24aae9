"""`verify` draws the states of a scene from shared and from per-coordinate ranges."""

from dataclasses import replace

import torch

from herglotz.scenes import scene
from herglotz.verify import verify
from herglotz.verify.subject import subject


def test_shared_and_per_coordinate_ranges_draw_the_same_states():
    # fails if a pair of tuples is not read as (low, high), or a pair of floats not as before
    shared = scene("damped_oscillator")
    per_coordinate = replace(shared, q_range=((-1.5,), (1.5,)), v_range=((-1.5,), (1.5,)))
    one, two = (subject(x, None, 16, 0).states for x in (shared, per_coordinate))
    for a, b in zip(one, two, strict=True):
        assert torch.equal(a, b)
    assert verify(per_coordinate, samples=8, steps=3).passed


def test_every_coordinate_keeps_to_its_own_range():
    # fails if one coordinate's range is used for all, or low and high are exchanged with the coordinates
    shared = scene("damped_oscillator")  # isotropic: its L_d takes any n
    two = replace(shared, coordinates=("x", "y"), q_range=((0.0, 5.0), (1.0, 6.0)), v_range=((-1.0, 2.0), (-0.5, 2.5)))
    states = subject(two, None, 200, 0).states
    assert states.q.shape == (200, 2)
    for x, low, high in ((states.q, (0.0, 5.0), (1.0, 6.0)), (states.p, (-1.0, 2.0), (-0.5, 2.5))):
        for i in range(2):
            assert low[i] <= float(x[:, i].min()) < low[i] + 0.1
            assert high[i] - 0.1 < float(x[:, i].max()) <= high[i]
    assert verify(two, samples=8, steps=3).passed
