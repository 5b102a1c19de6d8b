"""Compiled kernels of mechanisms and tracking, for every package that compiles its own."""
