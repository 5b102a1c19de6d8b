"""TLS certificates, issued by a private authority or requested from another authority.

A folder contains the authority (``ca.pem``, ``ca.key``) and the files of each server (``NAME.pem``,
``NAME.key``). Private keys are never overwritten; a certificate is renewed with its existing key.
"""

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from heliotrope.errors import FormatError, InputError
from heliotrope.links.keys import refuse_others, write_private

#: Names of the authority's files, and of a server's files by default.
AUTHORITY, SERVER = "ca", "console"
#: Validity of an authority, and maximum validity of a server certificate that browsers accept,
#: days.
_TEN_YEARS, LONGEST = 3650, 825
#: Clients' clocks may be slow by this much.
_EARLIER = timedelta(hours=1)


@dataclass(frozen=True)
class Certified:
    """Files of a server: its certificate or request, its key, and our own authority if it signs."""

    certificate: Path
    key: Path
    authority: Path | None


def certify(
    folder: Path, names: Sequence[str], now: datetime, *, days: int = LONGEST, server: str = SERVER
) -> Certified:
    """Create or renew a server certificate, signed by the authority in a folder.

    Parameters
    ----------
    folder
        Folder of the authority, which is created if missing.
    names
        Host names and addresses; the first is the name for display.
    now
        Start of the validity.
    days
        Validity in days, 1 to `LONGEST`.
    server
        Name of the server's files.

    Raises
    ------
    InputError
        If there is no name, a name is invalid, or a file cannot be written.
    FormatError
        If a key cannot be used.
    """
    if not 1 <= days <= LONGEST:
        raise InputError(
            f"keys tls: the validity must be 1 to {LONGEST} days, the most that browsers accept, "
            f"not {days} days"
        )
    subject, alternative = _subject(names)
    ours, signing = _authority(folder, now)
    place, key = _key(folder, server)
    made = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(ours.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(min(now + timedelta(days=days), ours.not_valid_after_utc))
        .add_extension(alternative, critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signing.public_key()),
            critical=False,
        )
        .sign(signing, hashes.SHA256())
    )
    file = folder / f"{server}.pem"
    write_private(file, made.public_bytes(Encoding.PEM).decode())
    return Certified(file, place, folder / f"{AUTHORITY}.pem")


def request(folder: Path, names: Sequence[str], *, server: str = SERVER) -> Certified:
    """Create a certificate request, to be signed by another authority; see `certify`."""
    subject, alternative = _subject(names)
    place, key = _key(folder, server)
    made = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(subject)
        .add_extension(alternative, critical=False)
        .sign(key, hashes.SHA256())
    )
    file = folder / f"{server}.csr"
    write_private(file, made.public_bytes(Encoding.PEM).decode())
    return Certified(file, place, None)


def _subject(names: Sequence[str]) -> tuple[x509.Name, x509.SubjectAlternativeName]:
    """Return the subject, and the names that a client compares with the address that it uses."""
    if not names:
        raise InputError(
            "keys tls: specify the name that users type, such as --name plant.example.org"
        )
    general = [_general(name) for name in names]
    common = x509.NameAttribute(NameOID.COMMON_NAME, names[0][:64])
    return x509.Name([common]), x509.SubjectAlternativeName(general)


def _general(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        pass
    parts = name.lower().split(".")
    for part in parts:
        plain = part.isascii() and part.replace("-", "a").isalnum() and part.strip("-") == part
        if not plain or len(part) > 63 or len(name) > 253:
            raise InputError(
                f"keys tls: {name!r} is neither a host name nor an address; use one such as "
                "plant.example.org"
            )
    return x509.DNSName(name.lower())


def _authority(folder: Path, now: datetime) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Return the authority in a folder and its key; create both if neither exists."""
    file = folder / f"{AUTHORITY}.pem"
    if file.exists():
        key = _read(folder / f"{AUTHORITY}.key")
        try:
            found = x509.load_pem_x509_certificate(file.read_bytes())
        except (OSError, ValueError):
            raise FormatError(file, "this is not a certificate; move it away") from None
        if found.public_key() != key.public_key():
            raise FormatError(
                file,
                (f"this certificate does not belong to {AUTHORITY}.key; restore the right one"),
            )
        return found, key
    _, key = _key(folder, AUTHORITY)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Heliotrope plant authority")])
    usage = dict.fromkeys(
        ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment",
         "key_agreement", "encipher_only", "decipher_only"), False
    )  # fmt: skip
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now + timedelta(days=_TEN_YEARS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **usage), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    write_private(file, made.public_bytes(Encoding.PEM).decode())
    return made, key


def _key(folder: Path, name: str) -> tuple[Path, ec.EllipticCurvePrivateKey]:
    """Return a key in a folder and its path; create the key if it is missing."""
    file = folder / f"{name}.key"
    if file.exists():
        return file, _read(file)
    made = ec.generate_private_key(ec.SECP256R1())
    text = made.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()).decode()
    write_private(file, text, new=True)
    return file, made


def _read(file: Path) -> ec.EllipticCurvePrivateKey:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror}); restore it") from None
    refuse_others(file)
    try:
        found = load_pem_private_key(data, None)
    except (ValueError, TypeError):
        raise FormatError(file, "not a private key without a password; move it away") from None
    if not isinstance(found, ec.EllipticCurvePrivateKey):
        raise FormatError(file, "not an elliptic-curve key; move it away")
    return found
