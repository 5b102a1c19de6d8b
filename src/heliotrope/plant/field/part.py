"""Hooks that notify the parts of a plant of events, in the order of their list."""

from collections.abc import Sequence

from heliotrope.links.messages import ClusterStatus, Stage
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Alarm


class Part:
    """Base of the parts that the plant controller runs.

    A part replaces the hooks that concern it; here they do nothing. The controller has one tuple of
    parts, and calls a hook of each in the order of the tuple. All times are monotonic, s.
    """

    def on_connected(self, cluster: str, now: float) -> None:
        """Act on a cluster that has connected: any boards may answer there."""

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Take a cluster's status, which the state of the field holds already."""

    def on_rows(self, cluster: str, now: float) -> None:
        """Act on the rows of a cluster, once every part has taken its status."""

    def on_alarm(self, cluster: str, alarm: Alarm) -> None:
        """Take an alarm of a cluster."""

    def on_sent(
        self,
        name: str,
        values: Sequence[float],
        heliostats: Sequence[str],
        now: float,
        again: bool,
    ) -> None:
        """Note a command that has been sent, or repeated (``again``), DEFOCUS and STOW too."""

    def on_stage(
        self, ticket: Ticket, heliostats: tuple[str, ...], stage: Stage, now: float
    ) -> None:
        """Note what some heliostats of a ticket have acknowledged, refused or done."""

    def on_beat(self, now: float) -> None:
        """Run the tasks of every beat (`PlantSettings.beat`)."""

    def on_second(self, now: float) -> None:
        """Run the tasks of every second, after the beat."""
