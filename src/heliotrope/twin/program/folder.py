"""The folder through which a plant reaches a simulated field: plant file, links file and keys."""

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote, urlsplit

import tomli_w

from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats.plant_file import write_plant
from heliotrope.field.plant import Plant
from heliotrope.links.keys import KeyFile
from heliotrope.plant.io.links_file import read_links
from heliotrope.plant.settings import clusters_of
from heliotrope.safety import FLUX_READING
from heliotrope.twin.weather import WeatherStation

#: Names of the files in the folder.
PLANT, LINKS, KEYS = "plant.toml", "links.toml", "keys.toml"


@dataclass(frozen=True)
class TwinFolder:
    """The files of a simulated field and the addresses in them.

    Attributes
    ----------
    folder
        Path of the folder.
    keys
        Key of each cluster.
    plant
        Host and port on which the plant listens for clusters.
    serves
        Host and port of the simulated field's own server.
    secret
        Part of that server's addresses, which other users of the computer cannot guess.
    """

    folder: Path
    keys: Mapping[str, bytes]
    plant: tuple[str, int]
    serves: tuple[str, int]
    secret: str


def write_folder(
    design: Plant,
    folder: Path,
    plant: tuple[str, int],
    serves: tuple[str, int],
    *,
    steps_every: int,
) -> TwinFolder:
    """Write the plant file, links file and keys of a simulated field into a separate folder.

    Parameters
    ----------
    design
        The plant; cameras get the addresses of the simulated field.
    folder
        Folder, which must not contain another simulated field.
    plant, serves
        Host and port on which the plant listens for clusters; host and port of the field's own
        server.
    steps_every
        Time between requests for step counts, s.

    Raises
    ------
    InputError
        If the folder already contains such files, or the plant has no clusters.
    """
    for name in (PLANT, LINKS, KEYS):
        if (folder / name).exists():
            raise InputError(
                f"{folder / name}: this file already exists; choose another folder, or delete the "
                "file"
            )
    homes, sensors = clusters_of(design), set(WeatherStation.names)
    if design.receivers:
        sensors.add(FLUX_READING)
    secret = secrets.token_urlsafe(24)
    base = _address(serves, secret)
    cameras = tuple(
        replace(camera, source=f"{base}/cameras/{quote(camera.name, safe='')}.png")
        for camera in design.cameras
    )
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_plant(replace(design, cameras=cameras), folder / PLANT, table="parquet")
    keys = KeyFile(folder / KEYS).new(list(homes))
    document = {
        "format": "heliotrope-links",
        "version": 1,
        "keys": KEYS,
        "twin": base,
        "tcp": {"listen": f"{plant[0]}:{plant[1]}"},
        "polling": {"steps_every_s": steps_every},
        "witness": {"none": True},
        "sensors": {name: sensor_file(name) for name in sorted(sensors)},
        "clusters": dict.fromkeys(homes, "tcp"),
    }
    (folder / LINKS).write_text(tomli_w.dumps(document), encoding="utf-8")
    return TwinFolder(folder, keys, plant, serves, secret)


def read_folder(folder: Path) -> TwinFolder:
    """Return the files of an earlier simulated field, so that it can run again.

    Raises
    ------
    FormatError
        If the files do not belong to a simulated field.
    """
    file = read_links(folder / LINKS)
    found = urlsplit(file.document.twin)
    if file.document.tcp is None or not found.hostname or not found.port:
        raise FormatError(
            folder / LINKS, "this is not a folder of a simulated field; choose a new folder", "twin"
        )
    host, _, port = file.document.tcp.listen.rpartition(":")
    keys = {name: ring.newest for name, ring in file.keys.items()}
    serves = found.hostname, found.port
    return TwinFolder(folder, keys, (host.strip("[]"), int(port)), serves, found.path.strip("/"))


def sensor_file(reading: str) -> str:
    """Return the file name of a sensor."""
    return f"{reading}.txt"


def _address(serves: tuple[str, int], secret: str) -> str:
    host = f"[{serves[0]}]" if ":" in serves[0] else serves[0]
    return f"http://{host}:{serves[1]}/{secret}"
