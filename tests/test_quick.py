"""`make quick`: which tests are near a change, in which order, and when they end."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from scripts.quick import changed, linters, nearest

ROOT = Path(__file__).parents[1]
FILES = {
    "src/heliotrope/__init__.py": "from heliotrope.sun import vector\n\n__all__ = ['vector']\n",
    "src/heliotrope/sun/__init__.py": "from heliotrope.sun.law import vector\n",
    "src/heliotrope/sun/law.py": "vector = 1\n",
    "src/heliotrope/sun/other.py": "moon = 1\n",
    "src/heliotrope/aim.py": "from heliotrope.sun import vector\n",
    "tests/support/bench.py": "from heliotrope.aim import vector\n",
    "tests/sun/test_law.py": "from heliotrope.sun.law import vector\n",
    "tests/test_door.py": "import heliotrope as ht\nht.vector\n",
    "tests/test_aim.py": "from heliotrope.aim import vector\n",
    "tests/test_bench.py": "from support.bench import vector\n",
    "tests/test_moon.py": "from heliotrope.sun.other import moon\n",
    "tests/test_page.py": "PAGE = 'docs/sun.md'\n",
    "tests/field/conftest.py": "from heliotrope.sun.other import moon\n",
    "tests/field/test_field.py": "",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A repository of a few files."""
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return tmp_path


def test_the_nearest_tests_come_first(tree: Path) -> None:
    """Names are followed through the faces of packages, and through the supports of tests."""
    assert list(nearest(tree, ["src/heliotrope/sun/law.py"]).items()) == [
        ("tests/sun/test_law.py", 1),
        ("tests/test_door.py", 1),
        ("tests/test_aim.py", 2),
        ("tests/test_bench.py", 3),
    ]


def test_fixtures_and_named_files_count_as_imports(tree: Path) -> None:
    assert set(nearest(tree, ["src/heliotrope/sun/other.py"])) == {
        "tests/test_moon.py",
        "tests/field/test_field.py",
    }
    assert nearest(tree, ["docs/sun.md"]) == {"tests/test_page.py": 1}
    assert nearest(tree, ["docs/moon.md"]) == {}
    assert nearest(tree, ["tests/test_moon.py"]) == {"tests/test_moon.py": 0}


def test_changed_files_are_those_of_the_branch_committed_or_not(tree: Path) -> None:
    def git(*words: str) -> None:
        who = ("-c", "user.name=x", "-c", "user.email=x@example.org")
        subprocess.run(["git", "-C", tree, *who, *words], check=True, capture_output=True)

    git("init", "-b", "main")
    git("add", "-A")
    git("commit", "-m", "Begin")
    git("checkout", "-b", "branch")
    assert changed(tree, "main") == []
    (tree / "tests/test_aim.py").write_text("# committed\n")
    git("commit", "-am", "Change")
    (tree / "tests/test_moon.py").write_text("# not committed\n")
    (tree / "new.py").touch()
    (tree / "tests/test_page.py").unlink()
    assert changed(tree, "main") == [
        "new.py", "tests/test_aim.py", "tests/test_moon.py", "tests/test_page.py",
    ]  # fmt: skip
    with pytest.raises(SystemExit, match=r"git merge-base: .*nowhere.*; name the files"):
        changed(tree, "nowhere")


def test_linters_read_the_changed_files_that_exist() -> None:
    assert linters(["docs/index.md", "src/heliotrope/deleted.py"]) == []
    names = [[Path(words[0]).name, *words[1:]] for words in linters(["src/heliotrope/errors.py"])]
    assert [words[0] for words in names] == ["ruff", "ruff", "lint-imports", "mypy"]
    assert names[0][-1] == names[1][-1] == "src/heliotrope/errors.py"
    assert len(linters(["tests/test_quick.py"])) == 2


@pytest.mark.parametrize(("seconds", "said"), [("60", "1 failed"), ("-1", "1 skipped")])
def test_no_test_begins_after_the_time(tmp_path: Path, seconds: str, said: str) -> None:
    test = tmp_path / "test_it.py"
    test.write_text("def test_it():\n    assert False\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "scripts.quick", "-c", "/dev/null", str(test)],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env={"PATH": "", "HELIOTROPE_QUICK_SECONDS": seconds},
    )  # fmt: skip
    assert said in done.stdout, done.stdout + done.stderr


def test_the_hooks_before_a_commit_are_local_and_exist() -> None:
    """They run from the environment of `make setup`, so a commit needs no network."""
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert repository["repo"] == "local"
    assert [hook["id"] for hook in repository["hooks"]] == ["ruff", "ruff-format", "mypy"]
    for hook in repository["hooks"]:
        assert hook["language"] == "system"
        assert (ROOT / hook["entry"].split()[0]).exists()
