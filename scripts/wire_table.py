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

This page specifies the frames and messages on the bus between a cluster and its local controllers. It is generated from the tables in the program (`python -m scripts.pages`); the code is in `heliotrope.lcu.wire`, `signing`, `messages` and `journal`.

## A frame

Numbers are little-endian. COBS encoding removes every zero byte from the frame, and a zero byte ends it. Including the COBS overhead and the final zero, a frame is at most {wire.FRAME_LIMIT} bytes long.

| bytes | content |
|---|---|
| 1 | version, {wire.VERSION}; {wire.SIGNED} if the frame is signed |
| 2 | address of the receiver; 0xFFFF: all; 0: the cluster controller |
| 2 | address of the sender |
| 2 | sequence number |
| 1 | type of the message |
| 0 to {wire.PAYLOAD_LIMIT} | payload |
| {wire.MAC_SIZE} | in messages that store settings: MAC, a truncated HMAC-SHA256 over all preceding bytes; in signed frames: the tag; absent in all other frames |
| 4 | CRC-32 over all preceding bytes (the same CRC as in zlib) |

A receiver ignores a frame with invalid byte stuffing, checksum, version or length, and only counts it. It also ignores a frame whose payload contains a number that is not finite. If the type of a frame is not in the table of messages, the receiver passes the payload on as bytes.

## What acts

A local controller acts on a frame under these conditions:

- It always obeys DEFOCUS and STOW, whoever sends them.
- It always answers questions, because they change nothing.
- Any other frame must be new. To make this recognisable, the sender numbers its frames with a 32-bit counter. Each frame carries the lower 16 bits as its sequence number. Once a second, the sender broadcasts SESSION with the upper 16 bits, its epoch and the token of the command authority. A SESSION is accepted if its pair (epoch, count) is greater than that of the last accepted SESSION. Any other frame is accepted if its sequence number is 1 to 32767 after the last accepted one. After a restart of the receiver or {wire.SILENCE_MS // 1000} s of silence, no other frame is accepted before a SESSION. The epoch must increase with every start of the sender; for example, it can be the GPS second of the start.
- A command that needs the command authority must carry the token of the last SESSION (0 means that nobody has the authority) and must not have expired. The command states the second in which it expires; by the receiver's clock, this second must not have passed, and must be at most {wire.HORIZON_S} s ahead. A receiver without a valid clock refuses every such command.
- A message that stores a setting must also carry a MAC made with the receiver's key, and an edition number greater than the last one stored. The edition is stored in the journal together with the setting, so a recorded message can never be replayed.

Except for the MAC, these rules only prevent accidents. They do not stop an attacker who has access to the bus; signed frames do.

## Signed frames

A bus may have a key of {signing.KEY_SIZE} bytes, which the cluster and its local controllers share ([how to](../how-to/bus-keys.md), [why](../decisions/0027-signed-frames.md)). The cluster then signs every message that the column *from* of the tables below assigns to *cluster* or *the authority*. A signed frame has version {wire.SIGNED} and a tag of {wire.MAC_SIZE} bytes before the CRC. The tag is a truncated HMAC-SHA256, with the bus key, over an 8-byte freshness value, the header and the payload. The freshness value itself is not sent:

| frame | freshness value |
|---|---|
| SESSION to one address | the random number that the local controller has sent in BUS; valid once |
| SESSION to all | the epoch and the 32-bit count, from the payload and the header of the frame |
| any other | the epoch of the last SESSION and the 32-bit count, which the receiver reconstructs from the sequence number |

- A local controller with a bus key refuses unsigned frames from the cluster or the authority (with the result "wrong key"). Messages that store settings still carry the MAC made with the controller's own key, and are not signed. DEFOCUS, STOW and questions are accepted from anyone. Because anyone can send a question, a question no longer counts as a sign that the cluster is alive.
- After a start, or after {wire.SILENCE_MS // 1000} s without a valid frame, the local controller sets the flag SESSION_WANTED in its STATUS. The cluster then sends QUERY_BUS, and a SESSION to the controller's address that is signed over the number from the reply. After a start, the controller accepts no other SESSION.
- SET_BUS_KEY carries the bus key, encrypted by XOR with the HMAC-SHA256 of the edition under the key of the local controller. It needs no session, and is accepted while the mirror is at rest (stowed, locked, idle, defocused, in FAULT, or unconfigured).
- A local controller without a bus key accepts signed frames and ignores their tags. Firmware that does not support signed frames counts them as frames of another version and does not act on them.
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
        f"Payloads from the authority begin with `{names}` (`{plain}`), or with `{keyed_names}` "
        f"(`{keyed}`) if they are sent with a key; the tables omit this beginning."
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
DAMAGE = """Ten million frames of all types were damaged at random in five ways and then decoded (`python -m benchmarks frames`). For comparison, ten million packets in the format of Malan's thesis were damaged in the same ways; these packets have a length and a one-byte checksum. They were separated by silence on the bus, which is the best case for that format. A false accept is a frame or packet that the receiver decodes although it was never sent.

| damage | frames | false accepts | packets | false accepts |
|---|---|---|---|---|
| one to three bits flipped | 2,002,029 | 0 | 1,999,834 | 49,962 (1 in 40) |
| 1 to 12 bytes in a row replaced | 1,998,410 | 0 | 2,002,136 | 6,588 (1 in 304) |
| 1 to 12 bytes lost | 1,998,129 | 0 | 1,998,924 | 0 |
| 1 to 12 bytes added | 2,000,954 | 0 | 2,000,746 | 0 |
| the head of one and the tail of another | 2,000,478 | 0 | 1,998,360 | 479 (1 in 4,171) |

If packets are not separated by silence, a receiver has to look for a packet at every byte; it then finds 38,897 packets in ten million bytes of noise. In version 2 of the wire, one in four thousand million heavily damaged frames (2^-32) is accepted by chance. Stored settings are additionally protected by a MAC."""  # noqa: E501
