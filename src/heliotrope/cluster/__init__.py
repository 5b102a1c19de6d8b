"""The cluster controller: master of one bus with up to 32 heliostats on it."""
