"""The plant at work: automatic control, and what people see and command of it."""
