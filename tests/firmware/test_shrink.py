"""The small build: numbers in place, nothing that is called left out, the rest gone."""

import ast
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

from heliotrope.lcu import names, states

ROOT = Path(__file__).parents[2]
tool: Any = runpy.run_path(str(ROOT / "scripts" / "shrink.py"))

ONE = '''
"""A module."""
from . import two
from .two import LIMIT, Base

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

STEP, OTHER = 3, 4
NAMES = ("go", "stay")
TEXT = "".join(["a " + name + "\\n" for name in NAMES])


class Root(Base):
    """Called."""

    def run(self, much: int) -> "Any":
        """Called from outside."""
        if much > LIMIT:
            raise ValueError(f"{much} is too much")
        kept: int = STEP
        return getattr(self, TEXT.split()[1])() + two.FACTOR * kept

    def go(self) -> int:
        return helper()

    def _unused(self) -> int:
        return unused()


def helper() -> int:
    return 5


def unused() -> int:
    return two.never()
'''
TWO = """
LIMIT, FACTOR = 10, 7


class Base:
    def __init__(self) -> None:
        self.seen = 0


def never() -> int:
    return 1
"""


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    folder = tmp_path / "shrunk_example"
    folder.mkdir()
    for name, text in (("__init__", ""), ("one", ONE), ("two", TWO)):
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    return dict(tool["shrink"]([("one", "Root")], folder, "shrunk_example"))


def test_what_is_called_stays_and_the_rest_goes(small: dict[str, str]) -> None:
    assert set(small) == {"__init__", "one", "two"}
    for gone in ("_unused", "def unused", "Any", "STEP", "LIMIT", "too much", "int", '"""'):
        assert gone not in small["one"]
    assert "never" not in small["two"]
    assert "a go" in small["one"]  # the text that names a method is written out


def test_it_does_the_same(small: dict[str, str], tmp_path: Path) -> None:
    again = tmp_path / "after" / "shrunk_again"
    again.mkdir(parents=True)
    for name, text in small.items():
        (again / f"{name}.py").write_text(text, encoding="utf-8")
    sys.path.insert(0, str(again.parent))
    try:
        from shrunk_again.one import Root  # type: ignore[import-not-found]
    finally:
        sys.path.pop(0)
    assert Root().run(2) == 5 + 7 * 3
    with pytest.raises(ValueError, match=r"^$"):
        Root().run(11)


def test_a_root_that_is_not_there_is_named() -> None:
    with pytest.raises(KeyError, match=r"node\.py defines no Nodes"):
        tool["shrink"]([("node", "Nodes")])


def test_of_the_core_only_what_a_board_runs_is_left() -> None:
    small = tool["shrink"]([("node", "Node")])
    assert "names" not in small
    assert "class Sender" not in small["wire"]
    assert "MESSAGES" not in small["messages"]
    for motion in ("hold", "defocus", "stow_directly", "approach", "search", "diagnose"):
        assert f"def {motion}(" in small["motion"]  # called by name from the state table


def test_private_attributes_share_short_names_and_no_class_confuses_two() -> None:
    modules = [
        tool["Module"](path.stem, path.read_text(encoding="utf-8"))
        for path in sorted(tool["CORE"].glob("*.py"))
    ]
    short = tool["shared_names"](modules)
    assert len(set(short.values())) < 0.5 * len(short)
    for module in modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ClassDef):
                own = {
                    inner.attr
                    for inner in ast.walk(node)
                    if isinstance(inner, ast.Attribute) and ast.unparse(inner.value) == "self"
                }
                assert len({short.get(name, name) for name in own}) == len(own), node.name


def test_the_states_become_letters_and_every_transition_stays() -> None:
    space: dict[str, Any] = {}
    exec(tool["shrink"]([("node", "Node")])["states"], space)
    assert len(space["TABLE"]) < 0.65 * len(states.TABLE)
    for state, event, _, _ in names.transitions():
        assert space["transition"](state, event) == states.transition(state, event)
    for state in range(len(states.STATES)):
        for event in (*names.EVENTS, "NONE"):
            assert space["transition"](state, event) == states.transition(state, event)
