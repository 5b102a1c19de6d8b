"""Starts the controller of one heliostat; `board` is that of the chip."""

import settings
from board import Board
from loop import Loop

Loop(Board(settings)).run()
