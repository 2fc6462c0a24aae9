"""Parts of `benchmarks/judge.py`: its rows, what makes their data, what scores a fit, tables and comparisons."""
