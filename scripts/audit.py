"""Check the installed packages without a network: pinned versions, and allowed licences.

python scripts/audit.py [--json]

It does not look up known vulnerabilities, which needs a service (see docs/how-to/deploy.md). The
exit code is 1 if a package is not pinned at the installed version, or its licence is unknown or not
allowed.
"""

import argparse
import json
import re
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import Distribution, distributions
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Tools of the environment itself, which no package of ours requires.
TOOLS = frozenset({"pip", "setuptools", "wheel", "uv", "heliotrope"})
#: Words of licences whose packages a program under MIT may use and ship.
ALLOWED = (
    "mit", "bsd", "0bsd", "apache", "isc", "psf", "python software foundation", "python-2.0",
    "cnri-python", "mpl", "mozilla public license", "lgpl", "lesser general public", "hpnd",
    "historical permission", "zlib", "unlicense", "public domain", "cc0", "zpl", "eupl",
    "epl", "eclipse", "edl", "blueoak", "ofl",
)  # fmt: skip
#: Licences missing from a package's metadata, with the place where they were read.
KNOWN: dict[str, str] = {}


@dataclass(frozen=True)
class Package:
    """An installed package.

    Attributes
    ----------
    name, version, licence
        From its metadata; the name is normalised.
    pinned
        Version in the constraints, "" if there is none.
    problem
        Problem of the package, "" if it has none.
    """

    name: str
    version: str
    licence: str
    pinned: str
    problem: str


def normal(name: str) -> str:
    """Return a package's name in the form of PEP 503."""
    return re.sub(r"[-_.]+", "-", name).lower()


def constraints(text: str) -> dict[str, str]:
    """Return the pinned version of each package."""
    lines = (line.partition("#")[0].strip() for line in text.splitlines())
    pairs = (line.partition("==") for line in lines if line)
    return {normal(name): version.partition(";")[0].strip() for name, _, version in pairs}


def licence_of(found: Distribution) -> str:
    """Return the licence named in a package's metadata, in one line."""
    meta = found.metadata
    said = [meta.get("License-Expression") or ""]
    said += [
        value.rpartition("::")[2].strip()
        for value in meta.get_all("Classifier") or []
        if value.startswith("License ::")
    ]
    said.append((meta.get("License") or "").strip().partition("\n")[0])
    good = [text for text in said if text and text != "OSI Approved"]
    return good[0][:80] if good else ""


def judge(name: str, version: str, licence: str, pins: dict[str, str]) -> Package:
    """Return a package with its problem, if any."""
    pinned, licence = pins.get(name, ""), licence or KNOWN.get(name, "")
    problem = ""
    if not pinned:
        problem = "it is not pinned; add it to constraints.txt"
    elif pinned != version:
        problem = f"installed is {version}, pinned is {pinned}"
    elif not licence:
        problem = "its metadata name no licence; read it, and note it in KNOWN"
    elif not allowed(licence):
        problem = f"licence {licence!r} is none of the allowed ones"
    return Package(name, version, licence, pinned, problem)


def allowed(licence: str) -> bool:
    """Return whether a licence, or one of several to choose from, is allowed."""
    words = re.split(r"\s+or\s+", licence.lower())
    return any(_known(part) for part in words)


def _known(text: str) -> bool:
    strict = re.search(r"(?<!l)(?<!lesser )(?:a?gpl|general public)", text)
    return strict is None and any(re.search(rf"\b{re.escape(word)}", text) for word in ALLOWED)


def audit() -> list[Package]:
    """Return all installed packages except the tools of the environment."""
    pins = constraints((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    found = {normal(one.metadata["Name"]): one for one in distributions() if one.metadata["Name"]}
    return [
        judge(name, one.version, licence_of(one), pins)
        for name, one in sorted(found.items())
        if name not in TOOLS
    ]


def main() -> None:
    """Print the problems."""
    parser = argparse.ArgumentParser(description="Pinned versions and licences of the packages.")
    parser.add_argument("--json", action="store_true", help="all packages, as JSON")
    given = parser.parse_args()
    packages = audit()
    wrong = [one for one in packages if one.problem]
    if given.json:
        print(json.dumps([asdict(one) for one in packages], indent=1))
    else:
        for one in wrong:
            print(f"{one.name} {one.version}: {one.problem}")
        print(
            f"{len(packages)} packages, {len(packages) - len(wrong)} pinned at the installed "
            "version with an allowed licence; known vulnerabilities were not looked up"
        )
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
