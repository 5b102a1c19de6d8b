"""A day in short, replayed: runs under CPython and MicroPython alike.

``given`` holds the journal's items, and events: (tick, hex of bytes that came, or None for a
tick of the main loop). What the controller orders is summed up in a checksum.
"""

import json
from binascii import crc32, unhexlify

try:
    from heliotrope.lcu import controller, wire
    from heliotrope.lcu.config import Config
except ImportError:  # on a board the folder is called lcu
    from lcu.config import Config

    from lcu import controller, wire


class Replay:
    """The controller, and a checksum of its actions after each of some events."""

    def __init__(self, given):
        config = Config()
        items = given["items"]
        assert config.load({name: unhexlify(items[name]) for name in items})
        self.controller = controller.Controller(config, given["start"], wire.Gate())
        self.reader = wire.Reader()
        self.sum, self.steps = 0, [0, 0]
        one, two = given["counts"]
        self.take(self.controller.boot(one, two, 0, 0, None, 1, False))

    def take(self, actions):
        for action in actions:
            if action[0] == controller.SEGMENT:
                self.steps[action[1]] += action[2] * action[3]
            if action[0] in (controller.SEGMENT, controller.BEFORE_STEPS, controller.AT_REST):
                self.sum = crc32(b"".join([b"%d," % value for value in action]), self.sum)

    def event(self, tick, data):
        if data is None:
            self.take(self.controller.on_tick(tick))
            return
        for frame in self.reader.feed(unhexlify(data)):
            self.take(self.controller.on_frame(frame, tick))

    def result(self):
        own = self.controller
        return [own.state, self.sum, self.steps, own.flags()]


def given_from(path):
    """Read what a test wrote."""
    with open(path) as file:  # noqa: PTH123 - MicroPython has no pathlib
        return json.load(file)
