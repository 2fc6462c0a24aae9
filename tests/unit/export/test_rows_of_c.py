"""Rows of a C function share their places on the stack."""

import re

import numpy as np

from herglotz.codegen.program import Program, whole


def test_a_row_gives_its_place_away_after_its_last_reader():
    # fails if a row that is read again is written over, if a statement writes into a row that it reads, or if no row
    # is given away
    program = Program()

    def times(a, b):
        return program.elementwise("{0} * {1}", lambda *_: None, a, b)

    x = np.empty(8, object)
    for i, number in enumerate(program.given("x", 8)):
        x[i] = number
    a = times(x, x)
    b = times(a, x)
    c = times(a, b)
    d = times(c, x)
    text = whole(program, "static void FN_f(const REAL x[8], REAL y[8])", {"y": list(d)})
    first, second, third, fourth = re.findall(r"\) (t\d+)\[k\] =", text)
    assert len({first, second, third}) == 3
    assert fourth in (first, second)
    assert text.count("REAL t") == 3
