"""Runs under MicroPython: does what vectors.json says, and prints what came out.

The last line of output is one JSON object; test_micropython.py compares it with CPython's.
Memory is collected at the lines of dashes only; see micropython.mjs.
"""

import gc
import hashlib
import json
import struct
import time
from binascii import crc32, hexlify, unhexlify

memory = [0] * 8
# ---
memory[0] = gc.mem_alloc()
from lcu import messages, wire  # noqa: E402

# ---
memory[1] = gc.mem_alloc()
from lcu import journal, ticks  # noqa: E402

# ---
memory[2] = gc.mem_alloc()
from nor import CutError, Nor  # noqa: E402

with open("/vectors.json") as file:  # noqa: PTH123
    given = json.load(file)
raws = [unhexlify(raw_hex) for raw_hex in given["frames"]]
reader = wire.Reader()


def handle():
    """Read 1000 frames and take their numbers out."""
    for turn in range(1000):
        for frame in reader.feed(raws[turn % len(raws)]):
            frame.values()


# ---
handle()
# ---
memory[3] = gc.mem_alloc()
handle()
# ---
memory[4] = gc.mem_alloc()
handle()
# ---
memory[5] = gc.mem_alloc()
# ---


def sha256(data):
    return hashlib.sha256(data).digest()


def plain(value):
    """Numbers as JSON carries them exactly: floats as the bytes of a double."""
    if isinstance(value, float):
        return "d" + hexlify(struct.pack("<d", value)).decode()
    if isinstance(value, bytes):
        return "s" + hexlify(value).decode()
    return value


def real(value):
    if isinstance(value, str):
        data = unhexlify(value[1:])
        return struct.unpack("<d", data)[0] if value[0] == "d" else data
    return value


def frames_there_and_back(vectors, key):
    """Decode, take apart, put together again, sign and encode."""
    out = []
    for raw_hex in vectors:
        raw = unhexlify(raw_hex)
        reader = wire.Reader()
        (frame,) = reader.feed(raw)
        values = frame.values()
        again = wire.Frame(
            frame.to, frame.sender, frame.sequence, frame.number, wire.pack(frame.name, *values)
        )
        if frame.mac:
            assert wire.verify(sha256, key, frame)
            again.mac = wire.authenticate(sha256, key, again)
        assert wire.encode(again) == raw
        out.append([frame.to, frame.sender, frame.sequence, frame.name, [plain(v) for v in values]])
    return out


def counts(stream_hex):
    reader = wire.Reader()
    stream = unhexlify(stream_hex)
    names = []
    for start in range(0, len(stream), 37):
        names += [frame.name for frame in reader.feed(stream[start : start + 37])]
    return names, [reader.good, reader.crc, reader.cobs, reader.length, reader.version]


def refusals(vectors):
    out = []
    for name, values in vectors:
        try:
            out.append(hexlify(wire.pack(name, *[real(value) for value in values])).decode())
        except ValueError as error:
            out.append(str(error))
    return out


def judged(vectors, key):
    gate = wire.Gate(sha256, key)
    out = []
    for raw_hex, tick, now_s in vectors:
        (frame,) = wire.Reader().feed(unhexlify(raw_hex))
        out.append(gate.judge(frame, tick, now_s))
    return out


def tick_sums(vectors):
    """As CPython, and as this machine's own functions."""
    out = []
    for tick, step, other in vectors:
        assert ticks.add(tick, step) == time.ticks_add(tick, step)
        assert ticks.diff(other, tick) == time.ticks_diff(other, tick)
        out.append([ticks.add(tick, step), ticks.diff(other, tick)])
    return out


def deadline(start, span, looks):
    end = ticks.Deadline()
    end.start(start, span)
    return [end.look(tick) for tick in looks]


def keep(vectors):
    """A fixed life of a journal; the flash must be the same to the bit."""
    flash = Nor()
    book = journal.Journal(flash)
    book.load()
    book.boot()
    here = 0
    for turn, (name, payload) in enumerate(vectors):
        book.store(journal.items_of(name, unhexlify(payload)))
        book.before_steps(here, -here, here + 900, -here - 900)
        here += 900
        book.note(turn % 7, struct.pack("<fff", turn, 2 * turn, 0.5))
        book.at_rest(here, -here)
    return crc32(flash.cells), [flash.erased[block] for block in range(4)]


def cuts(every):
    """Cut a store and a record at every few bytes; old or new must be there."""
    flash = Nor()
    book = journal.Journal(flash)
    book.load()
    book.boot()
    old = {"address": b"\1\0", "armature": bytes(144)}
    new = {"address": b"\2\0", "armature": b"\xaa" * 144}
    book.store(old)
    book.zero(1, 2)
    seen = [0, 0, 0]
    for ragged in (False, True):
        for budget in range(ragged, 512 + journal.SLOT_SIZE + journal.RING_SIZE + 9, every):
            cut = Nor(seed=budget)
            cut.cells[:] = flash.cells
            book = journal.Journal(cut)
            book.load()
            cut.budget, cut.ragged = budget, ragged
            try:
                book.store(new)
                book.zero(3, 4)
            except CutError:
                pass
            cut.budget = None
            book = journal.Journal(cut)
            items = book.load()
            state = (items == new) + ((book.primary, book.secondary) == (3, 4))
            assert items in (old, new), budget
            assert (book.primary, book.secondary) in ((1, 2), (3, 4)), budget
            seen[state] += 1
    return seen


def main():
    key = unhexlify(given["key"])
    out = {
        "memory": memory[:6],
        "frames": frames_there_and_back(given["frames"], key),
        "counts": counts(given["stream"]),
        "refusals": refusals(given["refusals"]),
        "judged": judged(given["judged"], key),
        "ticks": tick_sums(given["ticks"]),
        "deadline": deadline(*given["deadline"]),
        "keep": keep(given["keep"]),
        "cuts": cuts(given["every"]),
        "rows": len(messages.MESSAGES),
    }
    print(json.dumps(out))


main()
