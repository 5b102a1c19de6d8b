"""No test of this folder leaves a task behind, or an exception that nobody looked at."""

from support.tasks import no_leaked_tasks, quick_collections

__all__ = ["no_leaked_tasks", "quick_collections"]
