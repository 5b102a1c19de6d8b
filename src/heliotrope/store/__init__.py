"""What the plant remembers: a database of records and people, and an archive of telemetry."""
