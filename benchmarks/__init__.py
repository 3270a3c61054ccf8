"""Benchmarks: ours and a baseline in one run, at equal error."""
