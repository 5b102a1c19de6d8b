"""Safety: a table of conditions, its evaluation, and the proof of an emergency."""
