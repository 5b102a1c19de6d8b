"""Records of what users do with a plant's store: backups, exports, queries.

A running plant writes such a record itself, when the command asks for it over the local interface.
If the plant is stopped, the command writes the record to the store.
"""

import os
import sys
import time
from contextlib import closing
from pathlib import Path

from heliotrope.errors import HeliotropeError
from heliotrope.local import ORDINARY, AwayError, ask_once, name_here, socket_folder

#: Data folder of a plant with its store in PostgreSQL, as `heliotrope ctl` reads it.
_PLANT = "HELIOTROPE_PLANT"
#: Longest detail that a plant accepts.
_LONGEST = 400


def this_person() -> str:
    """Return the name under which the user of this process is recorded."""
    return name_here(os.geteuid())


def note_use(place: str, kind: str, detail: str) -> None:
    """Record a user's action in a plant's store; report if the record cannot be written.

    Parameters
    ----------
    place
        Data folder of a plant, or the URL of its database.
    kind, detail
        Name of a `SecurityEvent`, and a description of the action.
    """
    detail = " ".join(detail.split())[:_LONGEST]
    try:
        try:
            _ask_plant(place, kind, detail)
        except AwayError:
            _write(place, kind, detail)
    except HeliotropeError as error:
        sys.stderr.write(f"heliotrope: not recorded in the store: {error}\n")


def _ask_plant(place: str, kind: str, detail: str) -> None:
    folder = os.environ.get(_PLANT, "") if "://" in place else place
    if not folder:
        raise AwayError(f"the data folder of the running plant is unknown; set {_PLANT} to it")
    socket = socket_folder(Path(folder)) / ORDINARY
    ask_once(socket, {"user": True}, "note_use", {"kind": kind, "detail": detail})


def _write(place: str, kind: str, detail: str) -> None:
    from heliotrope.plant.operations.security import KIND, SecurityEvent, SecurityNote, plain
    from heliotrope.store.database import Database
    from heliotrope.store.keeper import Keeper
    from heliotrope.store.records import Event

    with Database(place) as database:
        database.require()  # a keeper would create a store if there were none
    known = SecurityEvent[kind]
    note = SecurityNote(known, time.time(), this_person(), "", plain(detail))
    with closing(Keeper(place)) as keeper:
        keeper.record_event(Event(note.at, KIND, f"{note.who}: {note.text}", known.severity))
