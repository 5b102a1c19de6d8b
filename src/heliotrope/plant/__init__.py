"""The plant controller: the one program that commands all clusters of a field."""
