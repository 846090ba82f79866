"""Speed and memory, measured by hand: `python -m experiments.benchmarks.run`."""
