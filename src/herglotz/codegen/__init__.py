"""From tensor code to C: a trace of operations, their lowering to statements, and the compiler with its cache."""
