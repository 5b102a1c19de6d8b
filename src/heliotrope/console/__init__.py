"""The operator's console: a page, an HTTP API and a live stream over one plant at work."""
