"""Synthetic photographs with exact truth."""
