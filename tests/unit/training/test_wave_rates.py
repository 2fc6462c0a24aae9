"""Rates of waves as arguments of a kernel: bases, multiples, and the standard numbers of a traced model."""

from itertools import product

import pytest

from herglotz.training.dictionary import waves_of_kind
from herglotz.training.rates import rates_of
from herglotz.training.waves import waves_of


def values(*terms):
    return sorted(rates_of(terms).values.values())


def test_waves_are_multiples_of_the_longest():
    # fails if a multiple is a base of its own, or the phase is taken for a rate
    assert values("sin(0.5123456 q1 + 0.2)", "sin(1.5370368 q1 + 0.6)", "cos(1.0246912 q1 + 0.4)") == [0.2, 0.5123456]


def test_the_base_of_a_band_of_short_waves_is_no_wave_of_the_band():
    # fails if the base is the longest wave that is there: the model would have no place in the dictionary
    assert values(*(f"sin({j * 0.5123456:.10g} v1)" for j in (4, 5, 6, 7))) == pytest.approx([0.5123456], rel=1e-12)


@pytest.mark.parametrize("terms", [
    ("cos(0.5123456 q1)", "cos(0.8234567 q1)"), ("cos(0.5123456 q1)", "cos(0.5123456 q2)"),
    ("cos(0.5123456 q1)", "cos(0.5123456 q1) v1"), ("cos(0.5123456 v1)", "cos(0.5123456 (v1 - v2))"),
])  # fmt: skip
def test_other_numbers_and_other_kinds_of_waves_have_other_bases(terms):
    # fails if two functions share a rate, which their intervals give each a value of its own
    assert len(rates_of(terms).values) == 2


def test_coordinates_have_one_ratio_and_one_kernel():
    # fails if each radius of a pulley asks for a kernel of its own, or powers and speeds have a ratio each
    texts = [f"({{}} q1 - q2)^{k}" for k in (2, 3, 4)] + ["({} q1 + q2)^4", "({} v1 - v2)"]
    found = []
    for ratio in ("19.99998", "0.33332"):
        own = tuple(text.format(ratio) for text in texts)
        rates = rates_of(own)
        assert list(rates.values.values()) == [float(ratio)]
        found.append(rates.standard(own))
    assert found[0] == found[1]
    assert len(rates_of(("(2.5 q1 - q2)^2", "(2.5 q1 - q3)^2")).values) == 2


def test_whole_numbers_are_constants():
    # fails if a harmonic of an angle, a power or an index is an argument
    rates = rates_of(("cos(3q1)", "sin(2q2) v1 v2", "q1^4", "cos(q1 - q2) v1 v2", "cos(2 q1) sgn(v1)", "|v1| v1"))
    assert not rates.values
    assert not rates.texts


@pytest.mark.parametrize("angles", [kind for n in (1, 2, 3) for kind in product((False, True), repeat=n)], ids=str)
def test_standard_numbers_stand_for_themselves(angles):
    # fails if a number of a traced model is a multiple of two standard numbers, so that a wave gets another's rate; or
    # if the interval decides which waves a kind of coordinates has
    features, drag = waves_of_kind(angles)
    rates = rates_of((*features, *drag))
    assert not rates.texts
    assert all(value == pytest.approx(base.standard, rel=1e-12) for base, value in rates.values.items())
    every = sorted(base.standard for base in rates.values)
    ratios = [b / a for i, a in enumerate(every) for b in every[i + 1 :]]
    near = [ratio for ratio in ratios for j in range(1, 101) if abs(ratio * j - round(ratio * j)) < 2e-9 * ratio * j]
    assert not near
    found = waves_of(angles, lambda form: (2.3, 0.7 / len(form)), [3.1] * len(angles), plane=True)
    texts = tuple(text for waves in found.values() for text, _ in waves)
    assert set(rates_of(texts).standard(texts)) == {*features, *drag}
