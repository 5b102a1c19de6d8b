"""A process that answers on a port as all local controllers of a bus would.

Its argument is the path of the port, or the number of an open file that it inherits.
"""

import os
import sys
import tty

from heliotrope.lcu import wire
from heliotrope.lcu.sender import Sender

_STEPS = (120_000, -45_000, 120_010, -45_000)
_STATUS = (5, 0x11, 0, 86_400, 950, 24_100, 31, 0x1234ABCD, 3)


def answer(frame: wire.Frame) -> bytes:
    """Return the answer of the local controller that a question addresses."""
    sender = Sender(frame.to, 1)
    sender.count = frame.sequence - 1
    if frame.name == "QUERY_STEPS":
        return sender.frame(0, "STEPS", *_STEPS)
    if frame.name == "QUERY_STATUS":
        return sender.frame(0, "STATUS", *_STATUS)
    return b""


def main() -> None:
    """Answer questions until the port is closed."""
    name = sys.argv[1]
    port = int(name) if name.isdigit() else os.open(name, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(port)
    reader = wire.Reader()
    print("ready", flush=True)
    while data := os.read(port, 4096):
        for frame in reader.feed(data):
            os.write(port, answer(frame))


if __name__ == "__main__":
    main()
