"""The console's users: the accounts in the store, and the first account."""

from heliotrope.console import _secrets
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.store.people import UNSET, People

ROLES = {"viewer": Role.VIEWER, "operator": Role.OPERATOR, "engineer": Role.ENGINEER}
#: Name of the first account.
FIRST = "engineer"


def first_start(people: People, now: float) -> str | None:
    """Create the first account if no account exists; set its password if none is set.

    Parameters
    ----------
    people
        Accounts of the store.
    now
        Time, POSIX s.

    Returns
    -------
    The account's password, to be printed once and changed at first use; None if the account already
    has a password.
    """
    if not without_password(people, now):
        return None
    password = _secrets.new_password()
    people.change(FIRST, now, password_hash=_secrets.hash_password(password), due=True)
    return password


def without_password(people: People, now: float) -> bool:
    """Create the first account, without a password, if no account exists.

    Parameters
    ----------
    people
        Accounts of the store.
    now
        Time, POSIX s.

    Returns
    -------
    Whether the first account has no password.
    """
    if people.empty():
        people.add(FIRST, UNSET, "engineer", now)
    first = people.account(FIRST)
    return first is not None and first.no_password


def person_of(name: str, role: str) -> Person:
    """Return an account as a person who can issue commands."""
    return Person(name, ROLES[role])
