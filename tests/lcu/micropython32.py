"""MicroPython as a program of 32 bits, with a heap of exactly the size that is asked for.

Debian builds it; its packages are fetched by apt-get and unpacked in the user's cache, nothing is
installed. Unlike the build for WebAssembly it collects memory while Python runs, and its heap does
not grow: what does not fit ends in MemoryError, as on a board. Pointers have 32 bits there too.
"""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from lcu.test_micropython import absent

RELEASE, VERSION = "trixie", "1.25.0"
PACKAGES = (
    "micropython", "libc6", "libffi8", "libmbedcrypto16", "libmbedtls21", "libmbedx509-7",
)  # fmt: skip
KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
LIBRARIES = "usr/lib/i386-linux-gnu"
NAME = "MicroPython of 32 bits"


def installed() -> Path:
    """Return the folder in which the packages are unpacked."""
    if shutil.which("apt-get") is None or shutil.which("dpkg-deb") is None or not KEYRING.exists():
        absent(f"{NAME}: comes from Debian's packages; needs apt-get and Debian's keyring")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "heliotrope"
    folder = cache / f"micropython-i386-{VERSION}"
    if not folder.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as fresh:
            root = _fetch(Path(fresh))
            try:
                root.rename(folder)
            except OSError:
                # Another process was quicker; its copy is as good.
                assert folder.exists()
    return folder


def _fetch(work: Path) -> Path:
    """Fetch the packages as apt-get does, by its own lists, from the mirror of this machine."""
    sites = _done(["apt-get", "indextargets", "--format", "$(SITE)", "Created-By: Packages"])
    site = next((line for line in sites.split() if "security" not in line), "")
    if not site:
        absent(f"{NAME}: apt-get has no mirror of Debian; see /etc/apt/sources.list")
    sources = work / "sources.list"
    sources.write_text(f"deb [arch=i386 signed-by={KEYRING}] {site} {RELEASE} main\n")
    (work / "lists" / "partial").mkdir(parents=True)
    settings = {
        "APT::Architecture": "i386", "APT::Architectures": "i386", "APT::Sandbox::User": "",
        "Acquire::Languages": "none", "Acquire::Retries": "3", "Dir::Etc::sourcelist": sources,
        "Dir::Etc::sourceparts": "-", "Dir::State::lists": work / "lists", "Dir::Cache": work,
    }  # fmt: skip
    apt = ["apt-get", "-qq", *(f"-o{key}={value}" for key, value in settings.items())]
    _done([*apt, "update"], work)
    _done([*apt, "download", *PACKAGES], work)
    root = work / "root"
    for package in sorted(work.glob("*.deb")):
        _done(["dpkg-deb", "-x", str(package), str(root)])
    return root


def _done(command: list[str], folder: Path | None = None) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        absent(f"{NAME}: {' '.join(command[:1] + command[-1:])}: {done.stderr.strip()[-300:]}")
    return done.stdout


def run32(heap: str, tree: Path, script: str) -> "subprocess.CompletedProcess[str]":
    """Run a script of a folder, in that folder, with a heap such as "64k"."""
    root = installed()
    libraries = root / LIBRARIES
    command = [
        libraries / "ld-linux.so.2", "--library-path", libraries, root / "usr/bin/micropython",
        "-X", f"heapsize={heap}", script,
    ]  # fmt: skip
    try:
        return subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    except OSError as error:
        absent(f"{NAME}: this machine does not run programs of 32 bits: {error.strerror}")
