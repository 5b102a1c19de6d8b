"""The people of the console: the store's accounts, and the first of them."""

from heliotrope.console import _secrets
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.store.people import People

ROLES = {"viewer": Role.VIEWER, "operator": Role.OPERATOR, "engineer": Role.ENGINEER}
#: Name of the first account.
FIRST = "engineer"


def first_start(people: People, now: float) -> str | None:
    """Create the first account if there is none.

    Parameters
    ----------
    people
        Accounts of the store.
    now
        POSIX s.

    Returns
    -------
    The account's password, to be printed once and changed at first use; None if there are accounts
    already.
    """
    if not people.empty():
        return None
    password = _secrets.new_password()
    people.add(FIRST, _secrets.hash_password(password), "engineer", now, due=True)
    return password


def person_of(name: str, role: str) -> Person:
    """Return the account as a person who commands."""
    return Person(name, ROLES[role])
