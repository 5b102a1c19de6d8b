"""``heliotrope drone``: plan, evaluate, check and simulate flights of a drone with a lamp."""
