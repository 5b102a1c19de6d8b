"""Benchmarks: every claim of speed is a ratio against a peer measured in the same run."""
