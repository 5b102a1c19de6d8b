"""A flight evaluated: photographs read, reflections identified, mirrors orientated, the report."""
