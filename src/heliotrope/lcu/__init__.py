"""The local controller of one heliostat: pure Python for MicroPython and CPython alike.

It imports nothing of the rest of Heliotrope, and of Python no more than ``math``, ``struct``
and ``binascii``. No dataclasses, typing, enum or match; integers for time.
"""
