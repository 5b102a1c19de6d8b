"""Runs the console for a plant, in its own process."""

import socket

from heliotrope.console.app import create
from heliotrope.console.connections import Limits
from heliotrope.console.remote import RemotePlant
from heliotrope.console.server import Server
from heliotrope.console.settings import ConsoleSettings


class ConsoleServer(Server):
    """The console of one plant.

    Parameters
    ----------
    plant, settings
        As in `app.create`; the settings contain the actual ports, see `listeners`.
    line
        Listening socket.
    """

    def __init__(self, plant: RemotePlant, settings: ConsoleSettings, line: socket.socket) -> None:
        self.app = create(plant, settings)
        super().__init__(self.app, line, Limits(), settings)
