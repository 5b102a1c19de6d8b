"""Passwords, stored as argon2id hashes."""

import secrets

import argon2

from heliotrope.console._guessable import weakness
from heliotrope.errors import InputError

#: Lengths of the shortest and the longest password; a longer one would cost the server too much to
#: hash.
SHORTEST, LONGEST = 10, 200
_HASHER = argon2.PasswordHasher()
#: Hash that is verified if there is no account, so that both cases take the same time.
_NOBODY = _HASHER.hash(secrets.token_hex(16))


def check_password(password: str, name: str = "") -> str:
    """Return the new password of an account if that password is acceptable.

    Raises
    ------
    InputError
        If the password is too short, too long, or easily guessed.
    """
    if not SHORTEST <= len(password) <= LONGEST:
        raise InputError(
            f"the password must have {SHORTEST} to {LONGEST} characters, not {len(password)}"
        )
    if reason := weakness(password, name):
        raise InputError(
            f"password: {reason}; choose a different one, such as three unrelated words"
        )
    return password


def hash_password(password: str) -> str:
    """Return the argon2id hash of a password, which takes about 50 ms."""
    return _HASHER.hash(check_password(password))


def verify_password(kept: str | None, password: str) -> bool:
    """Return whether a password matches a hash.

    The check takes the same time if there is no account, or if the account has no password.
    """
    known = kept if kept is not None and kept.startswith("$argon2") else None
    try:
        good = _HASHER.verify(known or _NOBODY, password)
    except (argon2.exceptions.VerificationError, argon2.exceptions.InvalidHashError):
        return False
    return bool(good) and known is not None


def new_password() -> str:
    """Return a random password of 100 bits in groups that can be read aloud."""
    letters = "abcdefghjkmnpqrstuvwxyz23456789"
    groups = ("".join(secrets.choice(letters) for _ in range(5)) for _ in range(4))
    return "-".join(groups)
