"""An intruder on the bus, who records, replays and forges frames and adds noise.

Only the MAC protects against an intruder who can replay recorded time and sun messages at the right
moment, and the MAC covers only stored items (see `lcu.wire`). This intruder has no token and no
key, and transmits at random moments, one frame at a time.
"""

import random

from heliotrope.lcu import messages, wire
from heliotrope.lcu.sender import Sender
from heliotrope.twin.boards.outfit import sha256
from heliotrope.twin.invariants.ledger import FrameLedger

#: Commands that the intruder forges.
WANTED = (
    "TRACK",
    "APPROACH",
    "REFOCUS",
    "IDLE",
    "AIM",
    "UNLOCK",
    "CLEAR_FAULT",
    "LOCK",
    "GOTO",
    "SET_BIAS",
    "ZERO",
    "SET_DEFOCUS",
)
#: Number of commands sent in about ten seconds.
_LATELY = 8
_NUMBERS: dict[str, tuple[float, ...]] = {
    "AIM": (0.0, 0.0, 50.0), "GOTO": (1000, 1000), "SET_BIAS": (0.1, 0.1), "ZERO": (0, 0),
    "SET_DEFOCUS": (0.05, 0.05),
}  # fmt: skip


class Intruder:
    """Frames that an intruder puts on the bus.

    Parameters
    ----------
    frames
        Frames recorded so far.
    addresses
        Addresses of the heliostats.
    """

    def __init__(self, frames: FrameLedger, addresses: list[int]) -> None:
        self._frames = frames
        self._addresses = addresses

    def recorded(self, size: float) -> bytes:
        """Return an earlier frame, chosen by ``size`` (0 to 1); empty if none was recorded.

        Half of the frames chosen are recent commands, which may not have expired yet.
        """
        commands, part = self._frames.commands[-_LATELY:], 2.0 * size % 1.0
        if size >= 0.5 and commands:
            return self._frames.data(commands[int(part * len(commands))])
        count = len(self._frames)
        return self._frames.data(int(part * count)) if count else b""

    def forged(self, target: int, size: float) -> bytes:
        """Return a command with an invented token and key for the heliostat at an index."""
        chance = random.Random(f"forgery {size}")
        name = chance.choice(WANTED)
        token, edition = chance.getrandbits(32) | 1, chance.randrange(1, 2**31)
        last = self._frames.last.get("SESSION")
        epoch = int(last.values[0]) if last is not None else 0
        sender = Sender(chance.choice([0, 0, 99]), epoch, sha256)
        # As if the intruder had counted along with the cluster.
        sender.count = chance.choice([len(self._frames), chance.randrange(1 << 16)])
        time = self._frames.last.get("SUN")
        expires = int(time.values[0]) + 5 if time is not None else 0
        is_key = messages.who_of(messages.NUMBER_OF[name]) == messages.KEY
        head = (token, expires, edition) if is_key else (token, expires)
        return sender.frame(
            self._addresses[target],
            name,
            *head,
            *_NUMBERS.get(name, ()),
            key=b"guessed" if is_key else b"",
        )

    def safe(self, target: int, size: float) -> bytes:
        """Return a DEFOCUS or STOW for one heliostat or all, after a zero that ends any noise."""
        chance = random.Random(f"safe {size}")
        to = chance.choice([self._addresses[target], wire.BROADCAST])
        sender = Sender(chance.choice([0, 77]), chance.getrandbits(16))
        return b"\0" + sender.frame(to, chance.choice(["DEFOCUS", "STOW"]))

    def noise(self, size: float) -> bytes:
        """Return random bytes with a terminator."""
        chance = random.Random(f"noise {size}")
        return bytes(chance.randrange(256) for _ in range(chance.randint(1, 300))) + b"\0"
