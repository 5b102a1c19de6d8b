"""Check packages and vendored JavaScript: pinned versions, licences, known vulnerabilities.

python scripts/audit.py [--json | --sbom | --vulnerabilities]

``--sbom`` prints a bill of materials in CycloneDX's format. ``--vulnerabilities`` asks the service
of PyPI by `pip-audit`, and says how many packages it knew: without a network, or behind a mirror
without that service, it knows none, which is no failure and no proof. Everything else needs no
network. The exit code is 1 if a package is not pinned at the installed version, its licence is
unknown or not allowed, or it has a known vulnerability.
"""

import argparse
import json
import re
import subprocess
import sys
import uuid
from dataclasses import asdict, dataclass
from importlib.metadata import Distribution, distributions, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
#: The program that looks up vulnerabilities, and how long it may take, s.
PIP_AUDIT, _PATIENCE = "pip-audit==2.10.1", 300.0
#: What is said where the service cannot be reached.
_UNKNOWN = "known vulnerabilities could not be looked up"
_ELSEWHERE = "run make audit where pypi.org can be reached"
#: Tools of the environment itself, which no package of ours requires.
TOOLS = frozenset({"pip", "setuptools", "wheel", "uv", "heliotrope"})
#: Words of licences whose packages a program under MIT may use and ship.
ALLOWED = (
    "mit", "bsd", "0bsd", "apache", "isc", "psf", "python software foundation", "python-2.0",
    "cnri-python", "mpl", "mozilla public license", "lgpl", "lesser general public", "hpnd",
    "historical permission", "zlib", "unlicense", "public domain", "cc0", "zpl", "eupl",
    "epl", "eclipse", "edl", "blueoak", "ofl",
)  # fmt: skip
#: Folders with minified JavaScript of others, whose first line names it.
VENDORED = ("src", "tests", "docs")
_BANNER = re.compile(r"/\*! (?:https://github\.com/[\w.-]+/)?(\w+) \(?v([\d.]+)\)?")
#: Their names at npm and licences, which stand beside them or in their text.
SCRIPTS = {"uPlot": ("uplot", "MIT"), "axe": ("axe-core", "MPL-2.0")}
#: Those of them that only tests use: they are no part of what is installed.
TEST_ONLY = frozenset({"axe-core"})
#: Licences that a package's metadata do not name, with the place where they were read.
KNOWN: dict[str, str] = {"embreex": "BSD-2-Clause"}  # its metadata hold the text without a name


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
    pinned, licence = pins.get(name, ""), KNOWN.get(name, licence)
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


def vendored(root: Path = ROOT) -> list[Package]:
    """Return the JavaScript libraries that come with the repository.

    A minified file that does not name itself, or a library that `SCRIPTS` lacks, is a problem.
    """
    found = []
    for path in sorted(p for folder in VENDORED for p in (root / folder).rglob("*.min.js")):
        banner = _BANNER.match(path.read_text(encoding="utf-8")[:200])
        if banner is None:
            problem = "its first line names no library and version"
            found.append(Package(path.name, "", "", "", problem))
            continue
        name, licence = SCRIPTS.get(banner[1], (banner[1].lower(), ""))
        problem = ""
        if not licence:
            problem = "its licence is not noted in SCRIPTS; read it, and note it"
        elif not allowed(licence):
            problem = f"licence {licence!r} is none of the allowed ones"
        found.append(Package(name, banner[2], licence, banner[2], problem))
    return found


def bill(
    packages: list[Package], scripts: list[Package], name: str, edition: str
) -> dict[str, Any]:
    """Return a bill of materials (CycloneDX 1.5, ECMA-424) of a program, packages and scripts."""
    installed = {normal(one.metadata["Name"]): one for one in distributions()}

    def needs(package: str) -> list[str]:
        """Return the references of what a package requires here."""
        texts = installed[package].requires or [] if package in installed else []
        names = {normal(re.split(r"[^\w.-]", text, maxsplit=1)[0]) for text in texts}
        return sorted(reference(one) for one in packages if one.name in names)

    def reference(one: Package) -> str:
        return f"pkg:{'npm' if one in scripts else 'pypi'}/{one.name}@{one.version}"

    root = f"pkg:pypi/{name}@{edition}"
    content = [
        {
            "type": "library",
            "bom-ref": reference(one),
            "name": one.name,
            "version": one.version,
            "purl": reference(one),
            "licenses": [{"license": {"name": one.licence or "unknown"}}],
            **({"scope": "excluded"} if one in scripts and one.name in TEST_ONLY else {}),
        }
        for one in (*packages, *scripts)
    ]
    shipped = [one for one in scripts if one.name not in TEST_ONLY]
    parts = map(reference, (*packages, *scripts))
    serial = uuid.uuid5(uuid.NAMESPACE_URL, "\n".join([root, *parts]))
    program = {"type": "application", "bom-ref": root, "name": name, "version": edition}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": f"urn:uuid:{serial}",
        "version": 1,
        "metadata": {"component": {**program, "purl": root}},
        "components": content,
        "dependencies": [
            {"ref": root, "dependsOn": [*needs(name), *map(reference, shipped)]},
            *({"ref": reference(one), "dependsOn": needs(one.name)} for one in packages),
            *({"ref": reference(one), "dependsOn": []} for one in scripts),
        ],
    }


def look_up() -> int:
    """Look up known vulnerabilities of the pinned packages; return the exit code."""
    words = ["--requirement", "constraints.txt", "--no-deps", "--disable-pip", "--format", "json"]
    program = [sys.executable, "-m", "uv", "tool", "run", PIP_AUDIT, *words]
    try:
        done = subprocess.run(  # noqa: S603 - pip-audit at a fixed version
            program, cwd=ROOT, capture_output=True, text=True, check=False, timeout=_PATIENCE
        )
        report = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        said = done.stderr.split("\n") if isinstance(error, ValueError) else [str(error)]
        why = next((line.strip() for line in reversed(said) if line.strip()), "no answer")
        print(f"{_UNKNOWN} ({why[:200]}); {_ELSEWHERE}")
        return 0
    vulnerable, text = judge_report(report)
    print("\n".join([*vulnerable, text]))
    return int(bool(vulnerable))


def judge_report(report: dict[str, Any]) -> tuple[list[str], str]:
    """Return a line for each vulnerability in a report of pip-audit, and how much it covers.

    A package that the service does not know is skipped by pip-audit, which then finds nothing.
    """
    every = report["dependencies"]
    known = [one for one in every if "skip_reason" not in one]
    lines = [
        f"{one['name']} {one['version']}: {flaw['id']}, "
        f"mended in {', '.join(flaw['fix_versions']) or 'no version yet'}"
        for one in known
        for flaw in one["vulns"]
    ]
    missing = len(every) - len(known)
    if not known:
        return [], f"{_UNKNOWN} (the service knew none of {missing} packages); {_ELSEWHERE}"
    rest = f"; {missing} could not be looked up, so nothing is known of them" if missing else ""
    text = f"{len(known)} of {len(every)} packages looked up, {len(lines)} vulnerabilities{rest}"
    return lines, text


def main() -> None:
    """Print the problems, all packages, the bill of materials, or known vulnerabilities."""
    parser = argparse.ArgumentParser(description="Pinned versions and licences of the packages.")
    parser.add_argument("--json", action="store_true", help="all packages, as JSON")
    parser.add_argument("--sbom", action="store_true", help="bill of materials, CycloneDX as JSON")
    parser.add_argument("--vulnerabilities", action="store_true", help="ask the service of PyPI")
    given = parser.parse_args()
    if given.vulnerabilities:
        sys.exit(look_up())
    packages, scripts = audit(), vendored()
    wrong = [one for one in (*packages, *scripts) if one.problem]
    if given.sbom:
        print(json.dumps(bill(packages, scripts, "heliotrope", version("heliotrope")), indent=1))
        return
    if given.json:
        print(json.dumps([asdict(one) for one in (*packages, *scripts)], indent=1))
    else:
        for one in wrong:
            print(f"{one.name} {one.version}: {one.problem}")
        print(
            f"{len(packages)} packages, {sum(not one.problem for one in packages)} pinned at the "
            "installed version with an allowed licence; --vulnerabilities looks up known ones"
        )
        listed = ", ".join(f"{one.name} {one.version} ({one.licence})" for one in scripts)
        print(f"{len(scripts)} JavaScript libraries in the repository: {listed}")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
