"""Measures the splatting backends: `python -m tests.benchmarks.splat`."""
