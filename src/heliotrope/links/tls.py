"""TLS for the links: contexts from PEM files, recreated when the files are renewed."""

import ssl
from collections.abc import Callable
from pathlib import Path

from heliotrope.errors import InputError

#: A context, or a function that returns the present context; None if there is no TLS.
TlsSource = ssl.SSLContext | Callable[[], ssl.SSLContext] | None


def context_of(source: TlsSource) -> ssl.SSLContext | None:
    """Return the present TLS context; None if there is no TLS."""
    return source if source is None or isinstance(source, ssl.SSLContext) else source()


def _load(context: ssl.SSLContext, certificate: str | Path, key: str | Path) -> None:
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise InputError(
            f"TLS: certificate {certificate} and key {key} cannot be used ({error}); specify two "
            "PEM files that belong together"
        ) from None


def _trust(context: ssl.SSLContext, authority: str | Path) -> None:
    try:
        context.load_verify_locations(authority)
    except (OSError, ssl.SSLError) as error:
        raise InputError(
            f"TLS: authority {authority} cannot be used ({error}); specify a PEM file"
        ) from None


def server_tls(
    certificate: str | Path, key: str | Path, authority: str | Path | None = None
) -> ssl.SSLContext:
    """Return the server's TLS context from PEM files.

    Parameters
    ----------
    certificate, key
        The server's own certificate and key.
    authority
        Authority that signed the clusters' certificates; None if clusters need no certificate,
        because they have keys.

    Raises
    ------
    InputError
        If the files cannot be used.
    """
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    _load(context, certificate, key)
    if authority is not None:
        _trust(context, authority)
        context.verify_mode = ssl.CERT_REQUIRED
    return context


def client_tls(
    authority: str | Path,
    certificate: str | Path | None = None,
    key: str | Path | None = None,
) -> ssl.SSLContext:
    """Return a cluster's TLS context from PEM files.

    Parameters
    ----------
    authority
        Authority that signed the server's certificate; no other authority is trusted.
    certificate, key
        The cluster's own certificate and key, both or neither.

    Raises
    ------
    InputError
        If the files cannot be used.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    _trust(context, authority)
    if (certificate is None) != (key is None):
        raise InputError("TLS: a certificate and its key belong together; specify both")
    if certificate is not None and key is not None:
        _load(context, certificate, key)
    return context


class RenewedTls:
    """A TLS context that is recreated when its files are renewed.

    Existing connections keep the old context.

    Parameters
    ----------
    make
        Function that creates a context from the files.

    Raises
    ------
    InputError
        If the files cannot be used.
    """

    def __init__(self, make: Callable[[], ssl.SSLContext]) -> None:
        self._make = make
        self._context = make()

    def __call__(self) -> ssl.SSLContext:
        """Return the context for a new connection."""
        return self._context

    def renew(self) -> None:
        """Recreate the context; if that fails, the present context stays in use.

        Raises
        ------
        InputError
            If the files cannot be used.
        """
        self._context = self._make()
