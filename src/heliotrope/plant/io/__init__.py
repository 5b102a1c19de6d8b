"""Input and output of a plant: the links file, cameras, sensors, receiver light and syslog."""
