"""The damped oscillator with a periodic force: step, flow and energies in closed form."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import ExactForcedOscillator
from herglotz.stepping import State
from herglotz.theory import TimeDependent, energies
from tests.lagrangians import states_in_turn

F64 = torch.float64
EXACT = ExactForcedOscillator(0.9, 1.7, 0.6, m=1.4, omega0=1.3, gamma=0.4)
SYSTEMS = {
    "under": EXACT,
    "over": ExactForcedOscillator(0.9, 1.7, 0.6, m=0.7, omega0=0.4, gamma=3.0),
    "undamped": ExactForcedOscillator(0.9, 1.7, 0.6, m=1.4, omega0=1.3, gamma=0.0),
    "free fall": ExactForcedOscillator(0.9, 1.7, 0.6, omega0=0.0, gamma=0.0),
}


def test_a_step_of_the_forced_oscillator_against_40_digits():
    # fails if the periodic motion, its action W or the shift of s is wrong; Taylor series with 40 digits (mpmath)
    start = State(*(torch.tensor(x, dtype=F64) for x in ([0.7], [-0.4], 0.2)))
    expected = (0.5693266379154660326576, -0.8183610265473707442067, 0.05809246775172919220025)
    step = TimeDependent(EXACT).step_at(start, 0.5, 0.3)
    for found in (step.state, EXACT.flow(*start, 0.5, 0.3)):
        for x, y in zip(found, expected, strict=True):
            assert abs(float(x) - y) < 1e-15 * 4
    L = EXACT(start.q, step.state.q, start.s, torch.tensor(0.5, dtype=F64), torch.tensor(0.3, dtype=F64))
    assert abs(float(L) + 0.1419075322482708077998) < 4e-15


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_exact_step_is_the_flow_and_its_energies_are_H(name):
    # fails if an energy has the wrong sign or is divided by c on the wrong side, at any damping
    L_d, x, t0, h = SYSTEMS[name], states_in_turn(), 2.3, 0.4
    end = TimeDependent(L_d).step_at(x, t0, h).state
    for a, b in zip(end, L_d.flow(*x, t0, h), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)
    q, p, s = L_d.flow(x.q, x.p, x.s, t0, 0.15)
    for a, b in zip(L_d.flow(q, p, s, t0 + 0.15, 0.25), end, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)
    before, after = energies(L_d, x.q, end.q, x.s, t0, h)
    torch.testing.assert_close(before, L_d.hamiltonian(x.q, x.p, x.s, t0), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(after, L_d.hamiltonian(end.q, end.p, end.s, t0 + h), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ExactForcedOscillator(1.0, 1.0, omega0=1.0, gamma=0.0), "at resonance without damping"),
        (lambda: ExactForcedOscillator(1.0, 0.0), "frequency must be > 0"),
        (lambda: ExactForcedOscillator(1.0, 1.0, m=0.0), "mass m must be > 0"),
    ],
)
def test_what_is_refused(make, message):
    # fails if a force without a periodic motion goes through
    with pytest.raises(InputError, match=message):
        make()
