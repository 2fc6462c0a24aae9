"""What the README and the docs claim, measured; each file says what its command does (`python benchmarks/NAME.py`)."""
