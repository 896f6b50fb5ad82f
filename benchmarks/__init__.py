"""Benchmarks: every claim about speed, measured as a ratio side by side in one run."""
