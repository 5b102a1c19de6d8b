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
        As for `app.create`; the ports of the settings are those that are used, see `lines`.
    line
        Listening socket.
    """

    def __init__(self, plant: RemotePlant, settings: ConsoleSettings, line: socket.socket) -> None:
        self.app = create(plant, settings)
        super().__init__(self.app, line, Limits(), settings)
