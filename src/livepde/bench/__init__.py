"""The project's benchmarks: ratios measured in one run, never absolute times."""
