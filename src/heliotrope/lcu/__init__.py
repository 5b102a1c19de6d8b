"""The local controller of one heliostat: pure Python for both MicroPython and CPython.

It imports nothing from the rest of Heliotrope, and from Python only ``math``, ``struct`` and
``binascii``. It uses no dataclasses, typing, enum or match, and integers for time.
"""
