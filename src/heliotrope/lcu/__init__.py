"""The local controller of one heliostat: pure Python for both MicroPython and CPython.

The package imports nothing from the rest of Heliotrope, and only ``math``, ``struct`` and
``binascii`` from Python's library. It uses no dataclasses, typing, enum or match, and represents
times as integers.
"""
