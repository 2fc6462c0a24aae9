"""Values among which settings choose, and a default, in a module without PyTorch: help on a command needs none."""

LEVELS = ("conservative", "linear", "affine", "full", "forced")
OBJECTIVES = ("auto", "residual", "trajectory", "smoothing", "raw")
OPTIMISERS = ("lm", "adam", "adamw")
SUPERVISION = ("q", "qs", "qps")
ROBUST = ("auto", "on", "off")
DTYPES = ("float64", "float32")
# What inputs do between samples (`herglotz.data.holds`).
HOLDS = ("zero", "first", "smooth")
# Kinds of files of figures.
FIGURES = ("png", "svg", "pdf")
# Samples from which `Run.predict` estimates the state.
WARMUP = 20
