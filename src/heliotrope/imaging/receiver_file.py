"""Read and write a receiver light reference (`receiver_light`): TOML, and a PNG."""

import math
from pathlib import Path
from typing import Literal

import numpy as np
import tomli_w
from pydantic import BaseModel, ConfigDict, Field

from heliotrope.errors import FormatError, InputError
from heliotrope.files.documents import read_document
from heliotrope.files.text import write_text
from heliotrope.imaging.files import read_image, write_image
from heliotrope.imaging.receiver_light import ReceiverReference, ReceiverSight


class ReceiverLightDocument(BaseModel):
    """Contents of the file, with linear levels as fractions of full scale."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["heliotrope-receiver-light"]
    version: Literal[1]
    camera: str = Field(min_length=1, description="Camera, as named in the plant file.")
    receiver: str = Field(min_length=1, description="Receiver, as named in the plant file.")
    size_px: tuple[int, int] = Field(description="Width and height of the camera's frames.")
    bits: Literal[8, 16] = Field(description="Bits of a value in the camera's frames.")
    gamma: float = Field(description="Exponent of the camera's response; 1 is linear.")
    outline_px: list[tuple[float, float]] = Field(
        description="Corners of the receiver in the frame, in order around it."
    )
    black: float = Field(description="Level with the lens capped.")
    face: float = Field(description="Level of the receiver in daylight, above black.")
    sides: tuple[float, float, float, float] = Field(
        description="Levels of the surroundings right, below, left, above; nan: not in the frame."
    )
    rise: float = Field(description="Rise of the receiver's level at nominal flux.")
    exposure_s: float | None = Field(
        None, description="Exposure times gain, if the frames record it."
    )
    surroundings: str = Field(min_length=1, description="PNG of the surroundings, beside the file.")


def read_reference(path: str | Path) -> ReceiverReference:
    """Read the reference from a file.

    Raises
    ------
    FormatError
        If the file or its PNG cannot be used.
    """
    path = Path(path)
    document = read_document(path, "receiver-light", ReceiverLightDocument, [ReceiverLightDocument])
    picture = read_image(path.parent / document.surroundings)
    try:
        sight = ReceiverSight(
            document.camera,
            document.receiver,
            document.size_px,
            np.array(document.outline_px, dtype=np.float64),
            document.gamma,
        )
        return ReceiverReference(
            sight,
            document.bits,
            document.black,
            document.face,
            np.array(document.sides),
            document.rise,
            picture.pixels,
            math.nan if document.exposure_s is None else document.exposure_s,
        )
    except InputError as error:
        raise FormatError(path, str(error)) from None


def write_reference(reference: ReceiverReference, path: str | Path) -> None:
    """Write a reference for `read_reference` to read, with its PNG beside it.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    path, sight = Path(path), reference.sight
    picture = path.with_suffix(".png")
    exposure = reference.exposure
    document = {
        "format": "heliotrope-receiver-light",
        "version": 1,
        "camera": sight.camera,
        "receiver": sight.receiver,
        "size_px": list(sight.size),
        "bits": reference.bits,
        "gamma": sight.gamma,
        "outline_px": sight.outline.tolist(),
        "black": reference.black,
        "face": reference.face,
        "sides": reference.sides.tolist(),
        "rise": reference.rise,
        **({"exposure_s": exposure} if math.isfinite(exposure) else {}),
        "surroundings": picture.name,
    }
    write_image(reference.surroundings, picture)
    write_text(path, tomli_w.dumps(document))
