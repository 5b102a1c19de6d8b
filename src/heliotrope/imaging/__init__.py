"""The target camera: from a photograph to a place in metres, or the reason why not."""
