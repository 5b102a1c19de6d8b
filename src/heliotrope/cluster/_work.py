"""Work on the bus: emergencies first, then commands and parameters, then queries."""

from heliotrope.cluster._emergencies import Emergencies
from heliotrope.cluster._epoch import Epoch
from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._nodes import ClusterNode, Nodes
from heliotrope.cluster._orders import Orders
from heliotrope.cluster._questions import Questions
from heliotrope.cluster._reports import Reports
from heliotrope.lcu import messages
from heliotrope.links.messages import Ask, Command, Emergency, Parameters, Stage


class Work:
    """Accepts orders and carries them out step by step, the most urgent first."""

    def __init__(
        self,
        nodes: Nodes,
        exchange: Exchange,
        emergencies: Emergencies,
        orders: Orders,
        questions: Questions,
        reports: Reports,
        epoch: Epoch,
    ) -> None:
        self._nodes, self._exchange, self._emergencies = nodes, exchange, emergencies
        self._orders, self._questions, self._reports = orders, questions, reports
        self._epoch = epoch

    def take(self, message: Emergency | Command | Parameters | Ask) -> None:
        """Accept an order or a query from the plant."""
        if isinstance(message, Emergency):
            self._take_named(message)
        elif isinstance(message, Parameters):
            self._orders.accept_parameters(message)
        elif isinstance(message, Ask):
            self._questions.take(message)
        else:
            self._take_named(message)

    def _take_named(self, message: Emergency | Command) -> None:
        """Accept an order for this cluster's heliostats, and refuse it for all other names."""
        nodes, unknown = self._nodes.chosen(message.heliostats)
        for name, refusal in unknown.items():
            self._reports.add(message.identity, Stage.REFUSED, name, refusal)
        if not nodes:
            return
        if message.name in messages.SAFE:
            self._take_emergency(message.identity, message.name, nodes)
        elif isinstance(message, Command):
            self._orders.accept(message, nodes)
        else:
            refusal = f"{message.name!r} is not an emergency order; order DEFOCUS or STOW"
            self._reports.add(message.identity, Stage.REFUSED, text=refusal)

    def _take_emergency(self, identity: str, name: str, nodes: list[ClusterNode]) -> None:
        self._orders.cancel(nodes, name, f"{name} came before it")
        self._emergencies.begin(identity, name, nodes)
        self._exchange.interrupt()

    def obey(self, name: str, why: str) -> None:
        """Carry out a DEFOCUS or STOW that the safety table requires; earlier orders are void."""
        self._orders.cancel(self._nodes, name, f"overruled: {why}")
        self._emergencies.begin("", name, list(self._nodes))

    def ready(self, *, patient: bool = True) -> bool:
        """Return whether there is work to do; queries count only if ``patient``."""
        return self._exchange.connected and (
            self._emergencies.pressing or self._orders.ready or (patient and self._questions.ready)
        )

    async def serve(self) -> None:
        """Carry out one step of the most urgent work."""
        if self._emergencies.pressing:
            await self._emergencies.serve()
        elif self._orders.ready:
            await self._orders.serve()
        else:
            await self._questions.serve()
        self._reports.publish()

    async def begin_second(self) -> None:
        """Resume work in a new second: request missing acknowledgements, emergencies first."""
        self._questions.second()
        self._epoch.second()
        self._emergencies.second()
        if self._emergencies.pressing and self._exchange.connected:
            await self._emergencies.serve()

    def resume(self) -> None:
        """Make ready the orders that are to be retried."""
        self._orders.second()
