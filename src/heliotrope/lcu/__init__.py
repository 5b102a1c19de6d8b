"""The local controller of one heliostat: pure Python for MicroPython and CPython alike.

It imports nothing from the rest of Heliotrope, and from Python only ``math``, ``struct``
and ``binascii``. No dataclasses, typing, enum or match; integers for time.
"""
