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

from support.absence import absent

RELEASE, VERSION = "trixie", "1.25.0"
#: Each package's file in the archive and its SHA-256, of 2026-11-24. They are taken where the lists
#: of a mirror do not agree with its release file, as while it is being renewed.
PACKAGES = {
    "micropython": (
        "main/m/micropython/micropython_1.25.0+ds-1_i386.deb",
        "a72799821cb45442150f8a7f0757bc8e4f9a4b64abccbd837d694a20d6900bb5",
    ),
    "libc6": (
        "main/g/glibc/libc6_2.41-12+deb13u4_i386.deb",
        "67bb4b54cf4bb6a380449dfa1852cd9135659f85360caa0e41d312f4b30e573a",
    ),
    "libffi8": (
        "main/libf/libffi/libffi8_3.4.8-2_i386.deb",
        "8bafefb38c320ca27796070c881595ce04d900c3b534ac142a494daf1fe1db13",
    ),
    "libmbedcrypto16": (
        "main/m/mbedtls/libmbedcrypto16_3.6.6-0.1~deb13u1_i386.deb",
        "aa4698ed436eebf77e3dc9f5c514073bd554109d857d887db5a367dde9a5c377",
    ),
    "libmbedtls21": (
        "main/m/mbedtls/libmbedtls21_3.6.6-0.1~deb13u1_i386.deb",
        "eb1b20154ce9008aca1d036698ffc12019020a54985d2c5ae3dc1c1c39c9e995",
    ),
    "libmbedx509-7": (
        "main/m/mbedtls/libmbedx509-7_3.6.6-0.1~deb13u1_i386.deb",
        "fe6ba192c9227d30a4cd05a3bdeccdf9ff30d55b27d8ff488126c16dcf727cce",
    ),
}
HELPER = "/usr/lib/apt/apt-helper"
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
    if not (_works([*apt, "update"], work) and _works([*apt, "download", *PACKAGES], work)):
        for path, digest in PACKAGES.values():
            file = work / Path(path).name
            _done([HELPER, "download-file", f"{site}/pool/{path}", str(file), f"SHA256:{digest}"])
    root = work / "root"
    for package in sorted(work.glob("*.deb")):
        _done(["dpkg-deb", "-x", str(package), str(root)])
    return root


def _works(command: list[str], folder: Path) -> bool:
    return not subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode


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
