"""Certificates of a private authority: a client that trusts it connects, by the names given."""

import socket
import ssl
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.errors import FormatError, InputError
from heliotrope.links.certificates import certify, request
from heliotrope.links.papers import end_of

NOW = datetime.now(UTC).replace(microsecond=0)
NAMES = ("Plant.example.org", "127.0.0.1")


def greeted(folder: Path, name: str) -> str:
    """Return the subject that a client sees who asks for a name and trusts the authority."""
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(folder / "console.pem", folder / "console.key")
    client = ssl.create_default_context(cafile=folder / "ca.pem")
    ours, theirs = socket.socketpair()

    def serve() -> None:
        try:
            with server.wrap_socket(theirs, server_side=True) as line:
                line.recv(1)
        except (ssl.SSLError, OSError):
            theirs.close()

    work = threading.Thread(target=serve)
    work.start()
    try:
        with client.wrap_socket(ours, server_hostname=name) as line:
            found = dict(pair for part in line.getpeercert()["subject"] for pair in part)
            line.send(b".")
            return found["commonName"]
    finally:
        ours.close()
        work.join()


def test_a_client_that_trusts_the_authority_connects(tmp_path: Path) -> None:
    made = certify(tmp_path, NAMES, NOW)
    for name in ("plant.example.org", "127.0.0.1"):
        assert greeted(tmp_path, name) == "Plant.example.org"
    with pytest.raises(ssl.SSLCertVerificationError, match="Hostname mismatch"):
        greeted(tmp_path, "other.example.org")
    assert end_of(made.certificate) == NOW + timedelta(days=825)
    assert {p.name: p.stat().st_mode & 0o777 for p in tmp_path.iterdir()} == dict.fromkeys(
        ("ca.pem", "ca.key", "console.pem", "console.key"), 0o600
    )
    # The authority signs servers alone, no further authority.
    authority = x509.load_pem_x509_certificate((tmp_path / "ca.pem").read_bytes())
    limits = authority.extensions.get_extension_for_class(x509.BasicConstraints).value
    assert (limits.ca, limits.path_length) == (True, 0)


def test_a_certificate_is_renewed_under_the_same_keys(tmp_path: Path) -> None:
    certify(tmp_path, NAMES, NOW, days=30)
    kept = {name: (tmp_path / name).read_bytes() for name in ("ca.pem", "ca.key", "console.key")}
    first = (tmp_path / "console.pem").read_bytes()
    certify(tmp_path, NAMES, NOW, days=60)
    assert {name: (tmp_path / name).read_bytes() for name in kept} == kept
    assert (tmp_path / "console.pem").read_bytes() != first
    assert greeted(tmp_path, "plant.example.org")


def test_a_request_names_the_hosts_and_proves_the_key(tmp_path: Path) -> None:
    made = request(tmp_path, NAMES)
    found = x509.load_pem_x509_csr(made.certificate.read_bytes())
    assert found.is_signature_valid
    names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["plant.example.org"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["console.csr", "console.key"]


@pytest.mark.parametrize(
    ("names", "days", "text"),
    [
        ((), 10, "specify the name that users type"),
        (("*.example.org",), 10, "is neither a host name"),
        (("a b",), 10, "is neither a host name"),
        (("x" * 64 + ".org",), 10, "is neither a host name"),
        (NAMES, 826, "must be 1 to 825 days"),
    ],
)
def test_what_is_refused_writes_nothing(
    tmp_path: Path, names: tuple[str, ...], days: int, text: str
) -> None:
    with pytest.raises(InputError, match=text):
        certify(tmp_path, names, NOW, days=days)
    assert not list(tmp_path.iterdir())


def test_keys_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    certify(tmp_path, NAMES, NOW)
    (tmp_path / "ca.key").chmod(0o644)
    with pytest.raises(FormatError, match=r"ca\.key: others may read it"):
        certify(tmp_path, NAMES, NOW)
    (tmp_path / "ca.key").unlink()
    with pytest.raises(FormatError, match=r"ca\.key: cannot be read"):
        certify(tmp_path, NAMES, NOW)
    (tmp_path / "ca.key").write_bytes((tmp_path / "console.key").read_bytes())
    (tmp_path / "ca.key").chmod(0o600)
    with pytest.raises(FormatError, match=r"ca\.pem: this certificate does not belong to ca\.key"):
        certify(tmp_path, NAMES, NOW)


def test_from_the_command_line(tmp_path: Path) -> None:
    run = CliRunner()
    words = ["keys", "tls", str(tmp_path), "--name", "plant.example.org"]
    made = run.invoke(app, words)
    assert made.exit_code == 0, made.output
    assert "--certificate and --key" in made.output
    assert run.invoke(app, [*words, "--request"]).exit_code == 0
    absent = run.invoke(app, ["keys", "tls", str(tmp_path / "none"), "--name", "a"])
    assert "no such folder" in str(absent.exception)
