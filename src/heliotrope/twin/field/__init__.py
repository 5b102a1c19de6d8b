"""A whole field of local controllers as arrays."""
