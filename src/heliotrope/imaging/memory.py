"""Models of a plant's empty targets, updated with each photograph."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from heliotrope.errors import InputError
from heliotrope.imaging.photograph import LookedAt
from heliotrope.imaging.spots.background import EmptyTarget


class Memory:
    """Models of empty targets, one per face.

    Parameters
    ----------
    models
        Initial models.

    Examples
    --------
    ::

        memory = Memory.load("empty")
        settings = PhotographSettings(empty=memory.models)
        photograph = read_photograph(frame, targets, settings=settings)
        memory.learn(photograph.faces)
        memory.save("empty")
    """

    def __init__(self, models: Iterable[EmptyTarget] = ()) -> None:
        self._models = {_name(model.targets): model for model in models}

    def __len__(self) -> int:
        return len(self._models)

    @property
    def models(self) -> Mapping[str, EmptyTarget]:
        """Models by target name, for `heliotrope.imaging.photograph.PhotographSettings`."""
        return self._models

    def learn(self, faces: Iterable[LookedAt]) -> None:
        """Update the models from faces, except where there are beams.

        A face that is mostly covered by beams or shadows, or has a different grid than before, is
        skipped.
        """
        for face in faces:
            picture = face.picture
            name = _name(tuple(target.name for target in picture.face.targets))
            model = self._models.get(name)
            if model is None:
                model = EmptyTarget.of(picture)
            if model.fits(picture) and face.background.seen >= _LEAST_FREE:
                self._models[name] = model.learn(picture)

    @classmethod
    def load(cls, folder: str | Path) -> "Memory":
        """Load the memory from a folder; it is empty if the folder does not exist.

        Raises
        ------
        FormatError
            If a file in the folder is not a model.
        InputError
            If the path is not a folder.
        """
        place = Path(folder)
        if place.exists() and not place.is_dir():
            raise InputError(f"{place}: not a folder; specify a folder for models of empty targets")
        return cls(EmptyTarget.load(file) for file in sorted(place.glob("*.npz")))

    def save(self, folder: str | Path) -> None:
        """Write each model to the folder, completely or not at all.

        Raises
        ------
        InputError
            If a model cannot be written.
        """
        place = Path(folder)
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{place}: {error.strerror}; specify a writable folder") from None
        for name, model in self._models.items():
            model.save(place / f"{name}.npz")


#: Minimum beam-free fraction of a face's paint for learning.
_LEAST_FREE = 0.3


def _name(targets: Iterable[str]) -> str:
    return "+".join(re.sub(r"[^\w.-]+", "_", name) for name in sorted(targets)) or "target"
