"""A plant of two heliostats as a person writes its file, with comments, and its table."""

TOML = """\
format = "heliotrope-plant"
version = 1
heliostats = "field.csv"  # the survey of 2025

[plant]
name = "small"

[site]
latitude_deg = -33.93
longitude_deg = 18.87

[[targets]]
name = "target"
center_m = [
    0.0,  # east
    0.0,
    13.0,
]
width_m = 3
height_m = 2
facing_deg = 180

[[targets.marks]]
name = "left"
kind = "disc"
at_m = [-1.0, 0.0, 13.0]
size_m = 0.1

[[receivers]]
name = "receiver"
center_m = [0.0, 0.0, 18.0]
normal = [0.0, -1.0, 0.0]
width_m = 2
height_m = 2

[[cameras]]
name = "eye"
size_px = [640, 480]
focal_px = [1000.0, 1000.0]
center_px = [320.0, 240.0]
targets = ["target"]

[groups.azel]
kind = "azimuth_elevation"
mirror_width_m = 1.83
mirror_height_m = 1.22
"""
TABLE = """\
name,group,east_m,north_m,up_m,parameters.tilt_north_rad
A1,azel,0,-30.00,0,0.002
A2,azel,10,-30.00,0,-0.001
"""
