"""Passwords that are guessed first: common passwords with variations, sequences, account names.

NIST SP 800-63B, section 3.1.1.2, requires such a list. A longer list would be of little use here,
because a password has ten characters or more, and guessing is slowed down (see `_attempts`).
"""

import itertools
import re

#: Common passwords, without the digits and signs that people add at either end.
_WORDS = """
abc abcd abcdef access admin administrator alexander america asdfasdf asdfghjkl baseball
basketball batman benutzer bienvenue blink butterfly changeme charlie chocolate computer
contrasena contraseña control controlroom cookie dallas default dragon einstein elephant engineer
enter field firstpassword flower football freedom geheim guest hallo heliostat heliotrope hello
hockey iloveu iloveyou internet jennifer jordan justdoit kennwort killer letmein liverpool login
lovely maintenance manager master mercedes michael michelle monkey motdepasse mustang mypassword
ninja nothing operator pass passphrase passw passwd password passwort peace plant please pokemon
princess qazwsx qazwsxedc qwert qwerty qwertyuiop qwertz qwertzuiop rockyou root samsung scada
secret security service shadow solar solarfield solarplant solartower sommer spring starwars
summer sunflower sunshine super superman superuser support system techsupport temporary temppass
test testing testtest tower trustno user username viewer welcome whatever winter world zaq zaqxsw
zxcvbn zxcvbnm
"""
_COMMON = frozenset(_WORDS.split())
_LETTERS = str.maketrans("4@831!0$5", "aabeiioss")
_ROWS = ("abcdefghijklmnopqrstuvwxyz", "01234567890", "qwertyuiop", "qwertzuiop", "asdfghjkl",
         "zxcvbnm", "yxcvbnm", "qazwsxedcrfvtgbyhnujmikolp", "1qaz2wsx3edc4rfv5tgb6yhn7ujm8ik9ol",
         "1q2w3e4r5t6y7u8i9o0p")  # fmt: skip
#: Minimum number of different characters, and maximum fraction of characters in runs.
_DIFFERENT, _RUNNING = 5, 0.75
_LEAST_RUN = 4


def weakness(password: str, name: str = "") -> str | None:
    """Return the reason why a password would be guessed early; None if no reason is known.

    Parameters
    ----------
    password
        Password as typed.
    name
        Name of the account.
    """
    small = password.casefold()
    if len(set(small)) < _DIFFERENT:
        return f"it has fewer than {_DIFFERENT} different characters"
    if _repeated(small):
        return "it repeats the same part"
    if _running(small) > _RUNNING * len(small):
        return "it follows the keyboard or the alphabet"
    read = {_bare(small), _bare(small.translate(_LETTERS)), _bare(small).translate(_LETTERS)}
    if any(_is_common(word) for word in read):
        return "it is a common password, or a variation of one"
    own = name.casefold()
    if len(own) > 2 and own in small and len(small) - len(own) < 8:
        return "it is little more than the name of the account"
    return None


def _repeated(text: str) -> bool:
    """Return whether a text consists of one repeated part."""
    return (text + text).find(text, 1) < len(text)


def _running(text: str) -> int:
    """Return how many characters of a text are in runs along a row, in either direction."""
    rows, count, place = [*_ROWS, *(row[::-1] for row in _ROWS)], 0, 0
    while place < len(text):
        longest = max(_common_run(text, place, row) for row in rows)
        count += longest if longest >= _LEAST_RUN else 0
        place += longest if longest >= _LEAST_RUN else 1
    return count


def _common_run(text: str, place: int, row: str) -> int:
    """Return the length of the run along a row that begins at a given position."""
    begin = row.find(text[place])
    if begin < 0:
        return 0
    pairs = zip(text[place:], row[begin:], strict=False)
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))


def _is_common(word: str) -> bool:
    """Return whether a word is common, or joins two common words with digits and signs."""
    pairs = ((_bare(word[:k]), _bare(word[k:])) for k in range(1, len(word)))
    return word in _COMMON or any(a in _COMMON and b in _COMMON for a, b in pairs)


def _bare(word: str) -> str:
    """Return a word without the digits and signs around it."""
    return re.sub(r"^[\W\d_]+|[\W\d_]+$", "", word)
