"""Names of the heliostats in a cluster's status rows, requested again if a message was lost."""

import math

from heliotrope.links.messages import Answer, ClusterStatus
from heliotrope.plant.field.clusters import Clusters
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState

#: Time after which a cluster is asked again for the names of its rows, s.
_AGAIN = 5.0


class RowNames(Part):
    """Queries the heliostat names that belong to status rows.

    Parameters
    ----------
    field, clusters
        The state of the field, which receives the names; the clusters, which are queried.
    """

    def __init__(self, field: FieldState, clusters: Clusters) -> None:
        self._field, self._clusters = field, clusters
        self._asked_at = dict.fromkeys(field.clusters, -math.inf)

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Query the heliostat names if the plant cannot interpret the rows of a status."""
        del status
        if self._field.knows_order(cluster) or now - self._asked_at[cluster] < _AGAIN:
            return
        self._asked_at[cluster] = now

        def learn(answer: Answer) -> None:
            if "error" not in answer.data:
                self._field.learn_order(cluster, tuple(answer.data))

        # The statistics follow the same order of heliostats.
        self._clusters.ask(self._clusters.ends[cluster], "statistics", learn)
