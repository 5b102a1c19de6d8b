"""The token that protects changes within a session, and constant-time comparison of secrets."""

import hashlib
import hmac


def csrf_of(session: str) -> str:
    """Return the CSRF token that a page must send with every change in a session."""
    return hmac.new(session.encode(), b"heliotrope csrf", hashlib.sha256).hexdigest()


def same(word: str, other: str) -> bool:
    """Return whether two texts are equal, in constant time."""
    # JSON may contain half a surrogate pair, for which UTF-8 has no bytes.
    said, meant = (word.encode(errors="surrogatepass") for word in (word, other))
    return hmac.compare_digest(said, meant)
