"""herglotz: learned discrete contact Lagrangians. Positions in, a verified stepper out."""

__version__ = "0.1.0"
