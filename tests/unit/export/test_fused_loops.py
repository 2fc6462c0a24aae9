"""Loops of a traced program that run as one."""

import numpy as np

from herglotz.codegen.c_function import fused
from herglotz.codegen.program import Program


def product(program, x, y):
    return program.elementwise("{0} * {1}", lambda *_: None, x, y)


def test_loops_that_read_one_another_are_one():
    # fails if a number that only the loop reads is stored, or one that is kept is not
    program = Program()
    x = np.array([*program.given("x", 16), None], object)[:-1]
    square = product(program, x, x)
    cube = product(program, square, x)
    texts, inner = fused(program, {1, 2}, {cube[0].statement})
    assert inner == {square[0].statement}
    assert texts == [
        "for (k = 0; k < 16; k++) {\n  const REAL v1 = @0[k] * @0[k];\n  const REAL v2 = v1 * @0[k];\n  @2[k] = v2;\n}"
    ]


def test_a_loop_runs_before_what_needs_its_row():
    # fails if a sum runs before the loop that it adds up, a loop that nothing needs yet does not wait, or entries that
    # are read out of order are taken for numbers of the same round
    program = Program()
    x = np.array([*program.given("x", 16), None], object)[:-1]
    square = product(program, x, x)  # 1
    other = product(program, x, 2.0)  # 2
    total = program.sum(square)  # 3
    back = product(program, square[::-1], other)  # 4
    last = product(program, other, np.array([total, None], object)[:1])  # 5
    texts, inner = fused(program, {1, 2, 3, 4, 5}, {back[0].statement, last[0].statement})
    assert [text.count("const REAL v") for text in texts] == [0, 0, 3]
    assert texts[0] == "for (k = 0; k < 16; k++) @1[k] = @0[k] * @0[k];"
    assert texts[1].startswith("const REAL @3 = FN_sum(16, @1)")
    assert "v4 = @1[-1 * k + 15] * v2;" in texts[2]
    assert inner == {2}


def test_loops_of_different_lengths_are_apart():  # fails if one counter runs over both
    program = Program()
    x = np.array([*program.given("x", 16), None], object)[:-1]
    product(program, x, x)
    product(program, x[:9], 3.0)
    assert [text.split(";")[1] for text in fused(program, {1, 2}, ())[0]] == [" k < 16", " k < 9"]


def test_a_row_that_is_needed_later_is_stored():
    # fails if a row that a later statement reads stays inside its loop, or a loop that has run is run again
    program = Program()
    x = np.array([*program.given("x", 16), None], object)[:-1]
    double = product(program, x, 2.0)  # 1
    square = product(program, double, x)  # 2
    cube = product(program, square, x)  # 3
    program.sum(square)  # 4
    program.sum(cube)  # 5
    texts, inner = fused(program, {1, 2, 3, 4, 5}, ())
    assert [text.split(" = ")[0].strip() for text in texts] == ["for (k", "const REAL @4", "for (k", "const REAL @5"]
    assert "@2[k] = v2;" in texts[0]
    assert texts[2] == "for (k = 0; k < 16; k++) @3[k] = @2[k] * @0[k];"
    assert inner == {1}
