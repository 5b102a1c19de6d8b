"""Positions in the arrays that the compiled kernels read.

A drive is a row of ``DRIVE_SLOTS`` numbers, so a field of any size is one array. Outside the
kernels a drive is a `Drive` and a parameter has a name; the integers below are not part of the
public interface.
"""

KIND = 0  # ROTARY or LINEAR
ZERO = 1  # rotary: angle at 0 counts, rad; linear: angle at the initial stroke, rad
RATE = 2  # rotary: rad per count, signed; linear: stroke per count, m
SENSE = 3  # linear: +1 if the angle grows with the stroke's decrease of Φ, else −1
STROKE = 4  # linear: distance of the actuator's ends at 0 counts, m
OFFSET = 5  # linear: distance from joint to the fixed end, m
RADIUS = 6  # linear: distance from joint to the moving end, m
BIAS = 7  # rad
SCALE = 8  # relative
WORM_COS = 9  # rad
WORM_SIN = 10  # rad
WORM_RATIO = 11  # periods per rad of angle (rotary), rad per m of stroke (linear)
SAG = 12  # rad
SAG_PHASE = 13  # rad
MIN_ANGLE = 14  # stop, rad
MAX_ANGLE = 15  # stop, rad
MIN_COUNT = 16  # stop, counts
MAX_COUNT = 17  # stop, counts
SPEED = 18  # counts per second
DRIVE_SLOTS = 19

ROTARY = 0.0
LINEAR = 1.0

# What a parameter moves.
MOVES_JOINT = 0  # the angle of joint `index`
MOVES_DRIVE = 1  # slot `sub` of drive `index`
MOVES_POSITION = 2  # component `sub` of the position, ENU
MOVES_ORIGIN = 3  # component `sub` of the origin of joint `index`, in its parent's frame
MOVES_VERTEX = 4  # component `sub` of the vertex, in the mirror's frame
MOVES_ALONG_NORMAL = 5  # the vertex along the normal

# Armature: 18 numbers in world coordinates at zero joint angles.
AXIS_1 = 0
ORIGIN_1 = 3
AXIS_2 = 6
ORIGIN_2 = 9
VERTEX = 12
NORMAL = 15
ARMATURE_SIZE = 18
