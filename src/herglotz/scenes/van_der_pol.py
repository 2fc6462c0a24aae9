"""Van der Pol's oscillator, ẍ = μ(1 − x²)ẋ − x: the damping is negative near 0, so there is a limit cycle of size 2.

L = v²/2 − x²/2 does not contain s. The damping is an external force, because one action s cannot express a rate that
changes sign with x. There is no closed form; the answer is the reference flow.
"""

from __future__ import annotations

from herglotz.scenes.natural import natural_scene
from herglotz.scenes.scene import Scene, require_positive


def van_der_pol(mu: float = 1.0) -> Scene:
    """The self-excited oscillator ẍ = μ(1 − x²)ẋ − x.

    Parameters
    ----------
    mu
        Strength μ > 0 of the damping, per unit of time; the cycle is a sine for small μ and jumps for large μ.

    Raise InputError if μ ≤ 0; without negative damping use the scene damped_oscillator.

    Source: B. van der Pol, On relaxation-oscillations, Phil. Mag. 2 (1926) 978.
    """
    require_positive("van_der_pol", mu=mu)

    return natural_scene(
        lambda q: 0.5 * q[..., 0] ** 2,
        lambda q: q,
        0.0,
        name="van_der_pol",
        description="self-excited oscillator, ẍ = μ(1 − x²)ẋ − x; reference flow to about 1e-13",
        coordinates=("x",),
        units=("1",),
        parameters={"mu": mu},
        external=lambda q, v: mu * (1.0 - q * q) * v,
        q_range=(-2.0, 2.0),
        v_range=(-1.5, 1.5),
        h=0.1,
        examples=({"mu": 1.4}, {"mu": 0.3}),
    )
