"""A simulated field for a live plant."""
