"""Start the controller of one heliostat; `board` is the module of the chip."""

import settings
from board import Board
from loop import Loop

Loop(Board(settings)).run()
