"""Learn chunks of heliostats on several computers with dask.distributed."""

from typing import TYPE_CHECKING, Any

from heliotrope.calibration.learn.learning import Part, Progress, Runner, learn_part
from heliotrope.errors import InputError

if TYPE_CHECKING:
    from distributed import Client


def connect(scheduler: str) -> "Client":
    """Return a client connected to ``scheduler``.

    Parameters
    ----------
    scheduler
        Address of a scheduler such as ``tcp://10.0.0.1:8786``, or ``local`` or ``local:N``
        for N processes on this computer.

    Raises
    ------
    InputError
        If dask.distributed is not installed, or no scheduler replies at this address.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError(
            "--scheduler needs dask.distributed; install it: pip install 'heliotrope[cluster]'"
        ) from None
    if scheduler == "local" or scheduler.startswith("local:"):
        number = scheduler.removeprefix("local").removeprefix(":")
        if number and not (number.isdigit() and int(number) > 0):
            raise InputError(f"scheduler {scheduler!r}: write local:4 for four processes")
        workers = int(number) if number else None
        machines = LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=workers, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
        )
        return Client(machines)  # type: ignore[no-untyped-call]
    try:
        return Client(scheduler, timeout="5s")  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"scheduler {scheduler!r}: no reply ({str(error).splitlines()[0]}); use "
            "tcp://HOST:PORT of a running dask scheduler, or local:N"
        ) from None


def runner(client: "Client") -> Runner:
    """Return a runner that learns chunks on the workers of ``client``, all at the same time."""

    def run(tasks: list[Any], progress: Progress | None) -> list[Part]:
        from distributed import as_completed

        futures = [client.submit(learn_part, *task, pure=False) for task in tasks]
        done = 0
        for future in as_completed(futures):  # type: ignore[no-untyped-call]
            done += len(tasks[futures.index(future)][0])
            if progress:
                progress(done, sum(len(task[0]) for task in tasks))
        parts: list[Part] = client.gather(futures)  # type: ignore[no-untyped-call]
        return parts

    return run


def disconnect(client: "Client") -> None:
    """Disconnect from the scheduler, and stop it if `connect` started it on this computer."""
    machines = client.cluster
    client.close()  # type: ignore[no-untyped-call]
    if machines is not None:
        machines.close()
