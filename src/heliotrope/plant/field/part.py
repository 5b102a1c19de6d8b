"""Hooks that notify the parts of a plant of events, in the order in which the parts are listed."""

from collections.abc import Sequence

from heliotrope.links.messages import ClusterStatus, Stage
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Alarm


class Part:
    """Base class of the parts that the plant controller runs.

    A part overrides the hooks that concern it; here they do nothing. The controller has one tuple
    of parts, and calls a hook of each in the order of the tuple. All times are monotonic, s.
    """

    def on_connected(self, cluster: str, now: float) -> None:
        """Handle a newly connected cluster; the boards there may have been replaced."""

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Handle a cluster's status, which the state of the field already contains."""

    def on_rows(self, cluster: str, now: float) -> None:
        """Handle the rows of a cluster's status, once every part has handled the status."""

    def on_alarm(self, cluster: str, alarm: Alarm) -> None:
        """Handle an alarm of a cluster."""

    def on_sent(
        self,
        name: str,
        values: Sequence[float],
        heliostats: Sequence[str],
        now: float,
        again: bool,
    ) -> None:
        """Note a command that was sent or repeated (``again``), including DEFOCUS and STOW."""

    def on_stage(
        self, ticket: Ticket, heliostats: tuple[str, ...], stage: Stage, now: float
    ) -> None:
        """Note that some heliostats of a ticket acknowledged, refused or completed its order."""

    def on_beat(self, now: float) -> None:
        """Run the tasks of every beat (`PlantSettings.beat`)."""

    def on_second(self, now: float) -> None:
        """Run the tasks of every second, after the beat."""
