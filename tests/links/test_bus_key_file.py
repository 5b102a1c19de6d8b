"""The file of a bus's key, and the commands that change it."""

from pathlib import Path

import pytest

from heliotrope.cli import main
from heliotrope.errors import FormatError, InputError
from heliotrope.links.bus_key_file import BusKeyFile, read_bus_keys


def keys_bus(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr("sys.argv", ["heliotrope", "keys", "bus", *map(str, words)])
    with pytest.raises(SystemExit) as found:
        main()
    return int(found.value.code or 0)


def test_a_key_is_made_rotated_and_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "C1.bus.toml"
    assert keys_bus(monkeypatch, "new", file) == 0
    (first,) = read_bus_keys(file)
    assert file.stat().st_mode & 0o777 == 0o600
    assert keys_bus(monkeypatch, "rotate", file) == 0
    second, old = read_bus_keys(file)
    assert old == first != second
    assert keys_bus(monkeypatch, "list", file) == 0
    assert keys_bus(monkeypatch, "end", file) == 0
    assert read_bus_keys(file) == (second,)
    assert keys_bus(monkeypatch, "off", file) == 0
    assert read_bus_keys(file) == ()
    shown = capsys.readouterr()
    for key in (first, second):
        assert key.hex() not in shown.out + shown.err
    assert ", old key " in shown.out


def test_a_step_out_of_order_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "C1.bus.toml"
    assert keys_bus(monkeypatch, "list", file) != 0
    assert "create it with heliotrope keys bus new" in capsys.readouterr().err
    found = BusKeyFile(file)
    with pytest.raises(InputError, match="it has no key; run"):
        found.rotate()
    found.new()
    with pytest.raises(InputError, match=r"already has a key; .* keys bus rotate"):
        found.new()
    with pytest.raises(InputError, match="no old key that a new one replaces"):
        found.end()
    found.rotate()
    with pytest.raises(InputError, match="already has two keys; run"):
        found.rotate()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("keys = 3\n", "only keys, a list of at most 2"),
        ("", "the file is empty"),
        ('key = ["00"]\n', "the file must contain only keys"),
        ('keys = ["abc"]\n', "not a key; a key has 16 bytes"),
        ('keys = ["zz112233445566778899aabbccddeeff"]\n', "not a key"),
        ('keys = ["' + "00" * 16 + '"]\n', "not a key"),
        ('keys = ["' + '", "'.join(["ab" * 16] * 2) + '"]\n', "a key occurs twice"),
        ('keys = ["' + '", "'.join(["ab" * 16] * 3) + '"]\n', "a list of at most 2"),
        ("keys = [1]\n", "not a key"),
    ],
)
def test_other_content_is_refused_and_never_shown(text: str, problem: str, tmp_path: Path) -> None:
    file = tmp_path / "C1.bus.toml"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(FormatError, match=problem) as caught:
        read_bus_keys(file)
    assert "abab" not in str(caught.value)
    assert "aabbcc" not in str(caught.value)


def test_two_commands_at_once_lose_no_key(tmp_path: Path) -> None:
    file = tmp_path / "bus.toml"
    BusKeyFile(file).new()
    one, two = BusKeyFile(file), BusKeyFile(file)
    one.rotate()
    with pytest.raises(InputError, match="another command has changed the file in the meantime"):
        two.rotate()
    assert BusKeyFile(file).keys == one.keys


def test_a_file_that_others_may_read_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "C1.bus.toml"
    BusKeyFile(file).new()
    file.chmod(0o640)
    with pytest.raises(FormatError, match=r"others may read it \(mode 640\); run chmod 600"):
        read_bus_keys(file)
