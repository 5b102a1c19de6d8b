"""Planning of measurements: what to measure next, and campaigns of a whole field."""
