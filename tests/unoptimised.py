"""C of the tests without optimisation, which takes the compiler 4 to 8 times as long, and decides no result."""

from herglotz.codegen import c_compiler
from herglotz.training import kernel


def leave_out_optimisation(put=setattr):
    """Of headers, of the kernels of fits, and of the loops around these; processes that do so share their libraries."""
    put(c_compiler, "FLAGS", tuple("-O0" if flag == "-O3" else flag for flag in c_compiler.FLAGS))
    put(kernel, "COMPILER_FLAGS", ("-O0",))
    put(kernel, "OPTIMISED", "")
