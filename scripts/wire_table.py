"""Make docs/reference/wire.md from the table of messages."""

import re
from pathlib import Path

from heliotrope.lcu import journal, messages, signing, wire

PAGE = "docs/reference/wire.md"
WHO = {
    messages.ANYONE: "anyone, always",
    messages.AUTHORITY: "the authority",
    messages.KEY: "the authority, with a key",
    messages.CLUSTER: "cluster",
    messages.ASK: "cluster (question)",
    messages.NODE: "local controller",
}
GROUPS = {
    0x00: "Questions and answers", 0x10: "Time, sun and session", 0x20: "Safety",
    0x30: "States", 0x40: "Aim and motion", 0x50: "Stored settings",
}  # fmt: skip
FRAME = f"""# The wire, version 2

This page is made from the tables in the program (`python -m scripts.pages`); the code is `heliotrope.lcu.wire`, `signing`, `messages` and `journal`.

## A frame

Numbers are little-endian. COBS removes every zero from the frame, and a zero ends it; with both it is at most {wire.FRAME_LIMIT} bytes long.

| bytes | content |
|---|---|
| 1 | version, {wire.VERSION}; {wire.SIGNED} if the frame is signed |
| 2 | to: address, 0xFFFF all, 0 the cluster controller |
| 2 | from |
| 2 | sequence |
| 1 | type |
| 0 to {wire.PAYLOAD_LIMIT} | payload |
| {wire.MAC_SIZE} | MAC, in messages that store: HMAC-SHA256 over all before it, truncated; in signed frames: their tag |
| 4 | CRC-32 over all before it (that of zlib) |

A frame whose stuffing, checksum, version or length is wrong changes nothing but a counter. A type that is not in the table is passed on with its bytes. A frame whose payload holds a number that is not finite does not act.

## What acts

- DEFOCUS and STOW, from anyone, always.
- Questions, always: they change nothing.
- Everything else must be new. The sender counts its frames in 32 bits; the lower 16 are the sequence, and once a second it broadcasts SESSION with the upper ones, its epoch and the token of the authority. A SESSION is accepted if its (epoch, count) is greater than the one held; any other frame, if its sequence is 1 to 32767 after the last one accepted. After a restart of the receiver or {wire.SILENCE_MS // 1000} s of silence, a SESSION must come first. The epoch rises with every start of the sender: the GPS second of the start serves.
- A command of the authority must carry the token of the last SESSION (0 is nobody's) and must not have expired: its last second is at most {wire.HORIZON_S} s ahead by the receiver's clock. Without a clock every command is void.
- A message that stores must also carry the MAC of the receiver's key, and an edition greater than the last one stored. The edition is kept in the journal with what was set, so a recorded message is void for ever.

All except the MAC prevents accidents; it does not stop a person at the bus. Signed frames do.

## Signed frames

A bus may have a key of {signing.KEY_SIZE} bytes, which its cluster and its local controllers share ([how to](../how-to/bus-keys.md), [why so](../decisions/0027-signed-frames.md)). The cluster then signs everything of the classes *cluster* and *the authority*: version {wire.SIGNED}, and a tag of {wire.MAC_SIZE} bytes before the CRC, HMAC-SHA256 under the key of the bus over a freshness value of 8 bytes, header and payload, truncated. The freshness value is not sent:

| frame | freshness value |
|---|---|
| SESSION to one address | the number that its local controller has drawn and told in BUS; good once |
| SESSION to all | epoch and 32-bit count, from its payload and header |
| any other | epoch of the last SESSION, and 32-bit count, which the receiver completes from the sequence |

- A local controller with a key refuses every unsigned frame of these classes ("wrong key"). Messages that store carry the MAC of its own key, as ever, and are not signed. DEFOCUS, STOW and questions are accepted from anyone; a question no longer counts as a sign of life of the cluster.
- After a start, or {wire.SILENCE_MS // 1000} s without a good frame, it shows SESSION_WANTED in its STATUS. The cluster asks QUERY_BUS and sends a SESSION to its address, signed over its number. After a start it accepts no other.
- SET_BUS_KEY carries the key added, modulo 2, to HMAC-SHA256 of the edition under the key of the local controller. It needs no session, and is taken while the mirror stands (stowed, locked, idle, defocused, in FAULT, unconfigured).
- A local controller without a key of the bus takes signed frames and ignores their tags. Firmware that does not know them counts them as of another version and does not act.
"""  # noqa: E501


def meanings() -> dict[int, str]:
    """Return the comment above each row of the table, by number of the message."""
    text = Path(messages.__file__).read_text(encoding="utf-8")
    found = {}
    for comment, number in re.findall(r"((?:^    # .*\n)+)^    \((0x[0-9A-F]{2}), ", text, re.M):
        found[int(number, 16)] = " ".join(
            line.strip().removeprefix("# ") for line in comment.splitlines()
        )
    return found


def pages() -> dict[str, str]:
    """Return the page's text, by path."""
    lines = [FRAME, "## Messages", ""]
    (plain, names), (keyed, keyed_names) = (
        messages.HEADS[messages.AUTHORITY],
        messages.HEADS[messages.KEY],
    )
    lines.append(
        f"Payloads from the authority begin with `{names}` (`{plain}`), with a key "
        f"`{keyed_names}` (`{keyed}`); the table leaves this head out."
    )
    said = meanings()
    for number, name, who, codes, fields, _ in messages.MESSAGES:
        if number & 0xF0 in GROUPS and number == min(
            row[0] for row in messages.MESSAGES if row[0] & 0xF0 == number & 0xF0
        ):
            lines += ["", f"### {GROUPS[number & 0xF0]}", ""]
            lines += ["| type | name | from | payload | meaning |"]
            lines += ["|---|---|---|---|---|"]
        payload = f"`{codes}`: {fields.replace(' ', ', ')}" if codes else ""
        lines.append(f"| 0x{number:02X} | `{name}` | {WHO[who]} | {payload} | {said[number]} |")
    lines += ["", "## Results in ACK", "", "| number | meaning |", "|---|---|"]
    lines += [f"| {number} | {text} |" for number, text in enumerate(messages.RESULTS)]
    lines += ["", "## Stored items", "", "| item | name | `struct` codes |", "|---|---|---|"]
    lines += [f"| {n} | `{name}` | `{codes}` |" for n, (name, codes) in enumerate(journal.ITEMS, 1)]
    lines += ["", "## Damaged frames", "", DAMAGE]
    return {PAGE: "\n".join(lines) + "\n"}


#: Measured by ``python -m benchmarks frames``.
DAMAGE = """Ten million frames of all types were damaged at random in five ways and read (`python -m benchmarks frames`), and ten million packets with the length and the one-byte sum of Malan's thesis, separated by silence, the best case for them. A false accept is a frame that comes out and was never sent.

| damage | frames | false accepts | packets | false accepts |
|---|---|---|---|---|
| one to three bits flipped | 2,002,029 | 0 | 1,999,834 | 49,962 (1 in 40) |
| 1 to 12 bytes in a row replaced | 1,998,410 | 0 | 2,002,136 | 6,588 (1 in 304) |
| 1 to 12 bytes lost | 1,998,129 | 0 | 1,998,924 | 0 |
| 1 to 12 bytes added | 2,000,954 | 0 | 2,000,746 | 0 |
| the head of one and the tail of another | 2,000,478 | 0 | 1,998,360 | 479 (1 in 4,171) |

A receiver of packets that looks at every byte, without silence, finds 38,897 of them in ten million bytes of noise. In version 2 a share of 2^-32 of heavily damaged frames passes by chance, one in four thousand million; a MAC protects stored settings."""  # noqa: E501
