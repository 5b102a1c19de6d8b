"""``heliotrope run``: a plant in operation with its console."""
