"""Plans of a drone campaign: clusters, hover patterns, flights, airspace and waypoint files."""
