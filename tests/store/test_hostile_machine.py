"""A clock that is set back or ahead, and links in the data folder: what they cannot do."""

from pathlib import Path

import pytest
from pyotp import TOTP

from heliotrope.cli.run._shared import FIRST_FILE, first_password
from heliotrope.errors import InputError
from heliotrope.local.sockets import make_folder
from heliotrope.store.database import Database, tighten
from heliotrope.store.factors import KEY_FILE
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import StoreError

HOUR, DAY = 3600.0, 86_400.0
NOW = 1.8e9


@pytest.fixture
def keeper(tmp_path: Path) -> Keeper:
    made = Keeper(tmp_path / "data", inline=True)
    made.people.add("anna", "hash", "engineer", NOW)
    return made


def test_a_clock_that_is_set_back_makes_no_code_good_again(keeper: Keeper, tmp_path: Path) -> None:
    """Neither one that was used nor one that was only seen."""
    factors = keeper.people.factors(tmp_path / KEY_FILE)
    secret = TOTP(factors.begin("anna", NOW))
    factors.confirm("anna", secret.at(int(NOW)), NOW)
    later = NOW + HOUR
    assert factors.check("anna", secret.at(int(later)), later) is not None
    for seen in (NOW + 600.0, later):
        for clock in (seen - 20.0, seen, seen + 20.0):
            assert factors.check("anna", secret.at(int(seen)), clock) is None
    keeper.close()


def test_a_clock_that_is_set_back_revives_no_session_that_was_removed(keeper: Keeper) -> None:
    keeper.people.open_session("anna", NOW, 10.0 * HOUR)
    _, token = keeper.people.add_token("anna", "report", "viewer", NOW, DAY)
    ended = keeper.people.forget_expired(NOW + 2.0 * DAY)
    assert [one.token for one in ended] == [False, True]
    assert keeper.people.valid(NOW).sessions == ()
    assert keeper.people.token(token, NOW) is None
    keeper.close()


def test_a_clock_that_is_far_ahead_makes_no_token_last_longer(keeper: Keeper) -> None:
    _, token = keeper.people.add_token("anna", "report", "viewer", NOW, 30.0 * DAY)
    assert keeper.people.token(token, NOW + 29.0 * DAY) is not None
    assert keeper.people.token(token, NOW + 3650.0 * DAY) is None
    keeper.close()


def test_links_in_the_data_folder_lead_nowhere(tmp_path: Path) -> None:
    """The plant may run as root, and somebody else may have made the folder before."""
    data, other = tmp_path / "data", tmp_path / "other"
    data.mkdir()
    other.mkdir()
    victim = other / "victim"
    victim.write_text("kept")
    victim.chmod(0o644)
    other.chmod(0o755)
    for name in ("store.sqlite.lock", FIRST_FILE):
        (data / name).symlink_to(victim)
    for name in ("telemetry", "photographs", "interface"):
        (data / name).symlink_to(other)
    with pytest.raises(
        StoreError, match=r"store\.sqlite: .*(symbolic links|choose a writable folder)"
    ):
        Database(data).lock()
    with pytest.raises(InputError, match="not a folder owned by this user"):
        make_folder(data / "interface")
    tighten(data)
    first_password("a password", data)
    assert victim.read_text() == "kept"
    assert (victim.stat().st_mode & 0o777, other.stat().st_mode & 0o777) == (0o644, 0o755)
    assert not (data / FIRST_FILE).is_symlink()
    assert (data / FIRST_FILE).stat().st_mode & 0o777 == 0o600
    assert [path.name for path in other.iterdir()] == ["victim"]
