"""Benchmarks: ours and a baseline in one run, at equal error. `python -m benchmarks NAME [--smoke] [--json FILE]`."""
