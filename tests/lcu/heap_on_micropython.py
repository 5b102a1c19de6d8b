"""Replays a day line by line, so that in the heap there is little beside the node."""

import gc
import json

from controller_on_micropython import Replay

with open("day.txt") as file:  # noqa: PTH123 - MicroPython has no pathlib
    begin, one, two = file.readline().split()
    items = {}
    line = file.readline().split()
    while line:
        items[line[0]] = line[1]
        line = file.readline().split()
    given = {"items": items, "counts": (int(one), int(two)), "start": int(begin)}
    day = Replay(given, "flash")
    del given, items
    for text in file:
        line = text.split()
        day.event(int(line[0]), line[1] if len(line) > 1 else None)
gc.collect()
print(json.dumps(day.result() + [gc.mem_alloc()]))
