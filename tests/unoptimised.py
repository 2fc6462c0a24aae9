"""C of the tests without optimisation, which takes the compiler 4 to 8 times as long, and decides no result."""

from herglotz.codegen import c_compiler
from herglotz.training import kernel

# Flags of headers, flags of the kernels of fits, and the pragma of the loops around a kernel.
UNOPTIMISED = (
    (c_compiler, "FLAGS", tuple("-O0" if flag == "-O3" else flag for flag in c_compiler.FLAGS)),
    (kernel, "COMPILER_FLAGS", ("-O0",)),
    (kernel, "OPTIMISED", ""),
)
OPTIMISED = tuple((module, name, getattr(module, name)) for module, name, _ in UNOPTIMISED)


def leave_out_optimisation(put=setattr):
    """From here on in this process; processes with the same setting share the libraries that they compile."""
    for module, name, value in UNOPTIMISED:
        put(module, name, value)
