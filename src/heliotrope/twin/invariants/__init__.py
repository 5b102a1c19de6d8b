"""The observer that checks the safety invariants."""
