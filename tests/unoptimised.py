"""C of the tests without optimisation, which takes the compiler 4 to 8 times as long, and decides no result."""

from herglotz.codegen import c_compiler
from herglotz.training import kernel


def leave_out_optimisation(put=setattr):
    """Of headers and of the traced functions of fits; processes that do so share their libraries.

    The loops of fits are few lines: -O1 compiles them as fast, and sweeps of a large kernel take a quarter less.
    """
    put(c_compiler, "FLAGS", tuple("-O0" if flag == "-O3" else flag for flag in c_compiler.FLAGS))
    put(kernel, "COMPILER_FLAGS", ("-O0",))
    put(kernel, "OPTIMISED", kernel.OPTIMISED.replace("O3", "O1"))
