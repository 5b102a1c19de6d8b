"""Files read and written safely: whole or refused in one line, never half-written."""
