"""Learn one group in its own process: ``python -m heliotrope.calibration.learn.worker``.

A plant starts this process at night and writes a pickled `GroupTask` to its input; the process
replies with one JSON document and ends. It uses only CPU time that other processes leave free.
"""

import json
import pickle
import sys
from typing import Any

from heliotrope.calibration.learn.group import (
    GroupTask,
    LearntGroup,
    document_of,
    learn_group,
    read_hyperparameters,
)
from heliotrope.errors import InputError
from heliotrope.processes import give_way

#: Number of threads of the process; the plant needs the other cores for its own work.
ENVIRONMENT = {"HELIOTROPE_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_LEAST_URGENT = 19


def asked(task: GroupTask) -> bytes:
    """Return a task as the bytes to send to the process."""
    return pickle.dumps(task)


def answered(text: bytes) -> LearntGroup:
    """Return the learnt group from the text that the process printed.

    Raises
    ------
    InputError
        If the output is not a valid result, or reports an error.
    """
    try:
        answer: dict[str, Any] = dict(json.loads(text))
    except (TypeError, ValueError) as error:
        raise InputError(f"the learning process returned no result ({error})") from error
    if problem := answer.get("error"):
        raise InputError(str(problem))
    try:
        counts = int(answer["heliostats"]), int(answer["sightings"])
        return LearntGroup(read_hyperparameters(answer["hyper"]), *counts, float(answer["gain"]))
    except (KeyError, TypeError) as error:
        raise InputError(
            f"the learning process returned an incomplete result ({error!r})"
        ) from error


def _answer(data: bytes) -> dict[str, Any]:
    try:
        task = pickle.loads(data)  # noqa: S301  # from the process that has started this one
        group = learn_group(task)
    except Exception as error:  # noqa: BLE001  # whatever it is, the plant says it in one line
        return {"error": f"{type(error).__name__}: {error}"}
    return {
        "hyper": document_of(group.hyper),
        "heliostats": group.heliostats,
        "sightings": group.sightings,
        "gain": group.gain,
    }


def main() -> None:
    """Learn the group read from standard input."""
    give_way(_LEAST_URGENT)
    sys.stdout.write(json.dumps(_answer(sys.stdin.buffer.read())))


if __name__ == "__main__":
    main()
