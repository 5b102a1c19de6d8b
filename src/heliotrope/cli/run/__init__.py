"""``heliotrope run``: a plant at work with its console."""
