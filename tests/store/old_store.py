"""One record of each kind, and the rows that hold them as a store keeps them.

``data/written_0002.json`` has the rows that `fill` left in a store before its columns had types of
their own, when each record was turned into a row by hand; those of ``parameter_sighting`` are of
revision 0009.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import text

from heliotrope.calibration.fit.estimator import FitOutcome
from heliotrope.calibration.record import CalibrationOutcome, HeliostatCalibration, Provenance
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.safety import Alarm, Severity
from heliotrope.store import audit, tables
from heliotrope.store.database import Database
from heliotrope.store.keeper import Keeper
from heliotrope.store.people import People
from heliotrope.store.records import (
    AuditEntry,
    CampaignEntry,
    Event,
    Kind,
    Lockout,
    VisitEntry,
)

FILE = Path(__file__).with_name("data") / "written_0002.json"
NAMES = ("A1", "Größe/2")
NAN = float("nan")
#: Links hold digests of the records of the other tables; nothing writes "plan"; others came later.
LATER = (
    "password_due", "second_factor", "recovery_code", "flight", "learning", "outlook", "timetable",
    "figures",
    "plan",
)  # fmt: skip
TABLES = [
    t.name
    for t in tables.metadata.sorted_tables
    if not t.name.endswith("_link") and t.name not in LATER
]

SEEN: Sightings = sightings(
    [0, 1, 0],
    [[1200.0, -7.5], [0.1, 3e5], [5.0, 6.0]],
    [[0.1, 0.2, 0.9], [1.0, 2.0, 3.0], [0.0, -0.5, 0.5]],
    [[10.0, 20.0, 1 / 3], [0.0, 0.6, 0.8], [7.0, 8.0, 9.0]],
    time=[1.8e9 + 1 / 7, NAN, 1.8e9],
    source_at_infinity=[True, False, True],
    destination_at_infinity=[False, True, False],
    sigma=[5e-4, 1 / 3000, 1e-3],
    destination_covariance=np.array([np.eye(3) * 1e-4, np.zeros((3, 3)), np.eye(3) / 3]),
)
CALIBRATIONS = (
    HeliostatCalibration(
        "A1",
        1.8e9 + 1 / 3,
        ("tilt_north", "tilt_east"),
        np.array([1 / 3, -2e-5]),
        np.array([[1e-8, 1e-9], [1e-9, 2 / 3]]),
        np.array([0.01, 0.02]),
        0.015,
        NAN,
        1.1,
        FitOutcome.NOT_CONVERGED,
        np.array([1, 3]),
        np.array([2]),
        np.array([[0.1, NAN], [1 / 7, -0.25]]),
        np.array([[1e-300, 0.0], [2.0, 3.0]]),
        "two",
        Provenance.DRONE,
        "anna",
        "spring",
        "note",
        ("POSITION", "AXES"),
        "1.2.3",
        version=1,
    ),
    HeliostatCalibration(
        "A1",
        1.8e9 + 9,
        (),
        np.zeros(0),
        np.zeros((0, 0)),
        np.zeros(0),
        outcome=FitOutcome.TOO_FEW,
        provenance=Provenance.TABLE,
        code="1.2.3",
        version=2,
    ),
)
VISITS = (
    VisitEntry(
        *("A1", "west", 10.0, 20.5, CalibrationOutcome.CALIBRATED, "calibrated"),
        *(0.3, 0.01, NAN, 1 / 3, float("inf"), 1e-4, 3, 1, "spring", 1),
    ),
    VisitEntry("Größe/2", "east", 11.0, 21.0, CalibrationOutcome.NO_BEAM, number=2),
)
CAMPAIGNS = (
    CampaignEntry("summer", 10.0),
    CampaignEntry("spring", 5.0, 9.0, "malan8", "n", {"rms": 1 / 3, "odd": NAN}, {"rms": 0.5}),
)
EVENTS = (
    Event(1.0, "test", "begun", Severity.INFO, number=1),
    Event(2.5, "cluster C12", "late", Severity.ALARM, "A1", {"x": 1 / 3, "y": NAN}, 2),
)
AUDIT = AuditEntry("p-1", "anna", "operator", "AIM", "t", (1.0, 1 / 3), ("A1", "Größe/2"), "n")
POINTS = {"AIM": {"A1": (1.0, 2.0, 1 / 3)}}


def fill(keeper: Keeper) -> None:
    """Record everything above."""
    keeper.record_sightings(NAMES, SEEN, target="west", campaign="spring")
    for calibration in CALIBRATIONS:
        keeper.record_calibration(calibration)
    for visit in VISITS:
        keeper.record(visit)
    for campaign in CAMPAIGNS:
        keeper.record(campaign)
    for event in EVENTS:
        keeper.record_event(event)
    keeper.record_alarm(Alarm("wind", "mast", Severity.WARNING, "12 m/s"), 1.0)
    keeper.record_alarm(Alarm("wind", "mast", Severity.WARNING, "", active=False), 2.5)
    keeper.record_acknowledgement("wind", "mast", "anna", 3.0)
    keeper.record_alarm(Alarm("rain", "", Severity.ALARM, "rain"), 4.0)
    holds = [Lockout(Kind.HELIOSTAT, name, "anna", "broken", 5.0, 50.0) for name in NAMES]
    keeper.hold(holds)
    keeper.unhold(holds[:1], "ben", 6.0)
    keeper.hold([Lockout(Kind.HELIOSTAT, "B", "ben", "for good", 7.0)])
    keeper.do(lambda c: audit.begin(c, AUDIT))
    keeper.do(lambda c: audit.finish(c, "p-1", "done", "t2"))
    keeper.do(lambda c: audit.change_points(c, POINTS, {}))
    people = People(keeper.database, keeper.writer, bytes)
    people.add("anna", "hash", "engineer", 1.0)
    people.open_session("anna", 1.0, 1e12, "tablet")
    people.add_token("anna", "report", "viewer", 1.0)
    keeper.writer.confirmed().result(10.0)


def raw_rows(database: Database) -> dict[str, list[Any]]:
    """Return the rows of each table as the database itself shows them."""
    shown = "SELECT * FROM {0}" if database.file is not None else "SELECT t::text FROM {0} t"
    with database._reader.connect() as connection:
        found = {name: connection.execute(text(shown.format(name))).all() for name in TABLES}
    return {name: sorted((list(row) for row in rows), key=repr) for name, rows in found.items()}


def put_raw_rows(database: Database, rows: dict[str, list[Any]]) -> None:
    """Write rows past the types of the columns."""
    with database._writer.connect() as connection, connection.begin():
        for name in TABLES:
            for row in rows[name]:
                marks = ", ".join("?" * len(row))
                put = f"VALUES ({marks})" if database.file is not None else f"SELECT (%s::{name}).*"
                connection.exec_driver_sql(f"INSERT INTO {name} {put}", tuple(row))


def written(database: Database) -> dict[str, list[Any]]:
    """Return the rows written before, for the kind of a database."""
    kinds = json.loads(FILE.read_text(encoding="utf-8"))
    rows: dict[str, list[Any]] = kinds["sqlite" if database.file is not None else "postgresql"]
    return rows
