"""The journal: whatever is cut, the old or the new record is there (invariant 7)."""

import random
import struct
import zlib
from collections.abc import Callable

import pytest

from heliotrope.lcu import journal, messages, wire
from lcu.nor import CutError, Nor

STYLES = pytest.mark.parametrize("ragged", [False, True], ids=["byte by byte", "ragged"])
FULL = {
    name: bytes((place + 7 * index) & 0xFF for place in range(journal.SIZE_OF[name]))
    for index, (name, _) in enumerate(journal.ITEMS)
}


def after_reset(flash: Nor) -> journal.Journal:
    """Read with the supply back, in a new object."""
    flash.budget = None
    book = journal.Journal(flash)
    book.load()
    return book


def started(flash: Nor) -> journal.Journal:
    book = after_reset(flash)
    book.boot()
    return book


def copy_of(flash: Nor, seed: int, budget: int, ragged: bool) -> Nor:
    copy = Nor(flash.blocks, flash.block_size, seed)
    copy.cells[:] = flash.cells
    copy.budget, copy.ragged = budget, ragged
    return copy


def often(book: journal.Journal) -> tuple[object, ...]:
    return (book.primary, book.secondary, book.state, book.aim, book.boots, book.unhealthy)


# What is stored.


def test_a_blank_flash_holds_nothing() -> None:
    book = after_reset(Nor())
    assert book.items == {}
    assert not book.damaged
    assert book.doubt == -1
    assert (book.numbers("armature"), book.checksum("armature")) == (None, 0)


def test_all_items_come_back_and_changes_leave_the_others() -> None:
    flash = Nor()
    book = started(flash)
    book.store(FULL)
    assert after_reset(flash).items == FULL
    book.store({"address": b"\x09\x00"})
    got = after_reset(flash)
    assert got.items == {**FULL, "address": b"\x09\x00"}
    assert got.numbers("address") == (9,)
    assert got.checksum("armature") == zlib.crc32(FULL["armature"])


def test_what_is_the_same_is_not_written_again() -> None:
    flash = Nor()
    book = started(flash)
    book.store(FULL)
    before = flash.operations
    book.store({"address": FULL["address"]})
    assert flash.operations == before


@pytest.mark.parametrize(
    ("changes", "text"),
    [({"speed": b""}, "0 bytes for item 'speed'"), ({"address": b"123"}, "3 bytes for item 'addr")],
)
def test_store_refuses(changes: dict[str, bytes], text: str) -> None:
    book = started(Nor())
    with pytest.raises(ValueError, match=text):
        book.store(changes)


@pytest.mark.parametrize(("blocks", "size"), [(3, 512), (4, journal.SLOT_SIZE - 1)])
def test_a_flash_too_small(blocks: int, size: int) -> None:
    with pytest.raises(ValueError, match=f"{blocks} blocks of {size} bytes: needs at least 4 of"):
        journal.Journal(Nor(blocks, size))


def cut_everywhere(
    flash: Nor,
    ragged: bool,
    act: Callable[[journal.Journal], None],
    check: Callable[[journal.Journal, bool], None],
) -> int:
    """Cut an operation at each byte; ``check`` gets what is read then, and whether it was whole."""
    for budget in range(100_000):
        cut = copy_of(flash, budget, 10**9, ragged)
        book = after_reset(cut)
        cut.budget = budget
        try:
            act(book)
        except CutError:
            check(after_reset(cut), False)
            if budget % 5 == 0:  # and it must go on from there
                again = started(cut)
                act(again)
                check(after_reset(cut), True)
            continue
        check(after_reset(cut), True)
        return budget
    raise AssertionError("never whole")


@STYLES
@pytest.mark.parametrize("stores", [0, 1, 2, 3])
def test_a_cut_store_leaves_the_old_or_the_new(ragged: bool, stores: int) -> None:
    flash = Nor()
    book = started(flash)
    old: dict[str, bytes] = {}
    for turn in range(stores):
        old = {**FULL, "address": bytes([turn, 0])}
        book.store(old)
    new = {name: bytes(byte ^ 0xFF for byte in data) for name, data in FULL.items()}
    seen = set()

    def check(got: journal.Journal, whole: bool) -> None:
        assert got.items in ([new] if whole else [old, new])
        assert not got.damaged or stores == 0
        seen.add(got.items == new)

    points = cut_everywhere(flash, ragged, lambda book: book.store(new), check)
    assert points >= 512 + journal.SLOT_SIZE
    assert seen == {False, True}


def test_damage_is_told_from_a_new_board() -> None:
    flash = Nor()
    started(flash).store(FULL)
    flash.cells[100] ^= 1
    book = after_reset(flash)
    assert book.items == {}
    assert book.damaged
    book.store(FULL)
    assert not book.damaged
    assert after_reset(flash).items == FULL


def test_an_old_layout_is_not_taken() -> None:
    flash = Nor()
    started(flash).store(FULL)
    flash.cells[1] = journal.LAYOUT + 1
    body = bytes(flash.cells[: journal.SLOT_SIZE - 4])
    flash.cells[len(body) : len(body) + 4] = struct.pack("<I", zlib.crc32(body))
    assert after_reset(flash).items == {}


def test_flash_that_does_not_hold() -> None:
    flash = Nor()
    book = started(flash)
    book.store(FULL)
    flash.stuck = flash.block_size + 40
    with pytest.raises(OSError, match="block 1 does not hold what was written; replace the board"):
        book.store({"address": b"xx"})
    assert book.items == FULL
    assert after_reset(flash).items == FULL


def test_counters_wrap() -> None:
    flash = Nor()
    book = after_reset(flash)
    book._slot_counter = book._counter = 0xFFFFFFF0
    book.boot()
    for turn in range(40):
        book.store({"key_id": struct.pack("<I", turn)})
        book.zero(turn, -turn)
        got = after_reset(flash)
        assert got.numbers("key_id") == (turn,)
        assert (got.primary, got.secondary) == (turn, -turn)


@pytest.mark.parametrize("name", list(journal.TARGETS))
def test_what_messages_store(name: str) -> None:
    codes = wire._single(messages.codes_of(messages.NUMBER_OF[name]))
    for axis in range(2):
        values = [axis if code == "B" else 1000 + place for place, code in enumerate(codes)]
        if name == "SET_DRIVES":
            values[4] = 3  # its kind
        payload = wire.pack(name, *values)
        items = journal.items_of(name, payload)
        started(Nor()).store(items)
        assert items.pop("edition") == struct.pack("<I", 1002)
        targets = journal.TARGETS[name]
        assert list(items) == list(targets[axis : axis + 1] if len(targets) == 2 else targets)
        skipped = 1 if len(targets) == 2 or name == "SET_ADDRESS" else 0
        for item, data in items.items():
            assert list(struct.unpack(journal.CODES_OF[item], data)) == values[3 + skipped :]


def test_every_message_with_a_key_has_its_place() -> None:
    keyed = {row[1] for row in messages.MESSAGES if row[2] == messages.KEY}
    assert set(journal.TARGETS) == keyed - {"SET_BUS_KEY"}  # which the node itself obeys
    assert {journal.item_name(n) for n in range(1, len(journal.ITEMS) + 1)} == set(FULL)
    assert journal.item_name(0) == journal.item_name(len(journal.ITEMS) + 1) == ""


def test_items_of_refuses() -> None:
    with pytest.raises(ValueError, match="STEPS: stores nothing"):
        journal.items_of("STEPS", bytes(16))
    payload = wire.pack("SET_LIMITS", 1, 2, 3, 2, 0, 0, 0, 0, 0)
    with pytest.raises(ValueError, match=r"SET_LIMITS: axis 2: must be 0 \(primary\) or 1"):
        journal.items_of("SET_LIMITS", payload)


# What changes often.


def test_a_new_board_knows_no_counts_until_told() -> None:
    flash = Nor()
    book = started(flash)
    assert book.doubt == -1
    assert after_reset(flash).doubt == -1
    book.zero(10, -20)
    got = after_reset(flash)
    assert (got.primary, got.secondary, got.doubt) == (10, -20, 0)


def test_state_and_aim() -> None:
    flash = Nor()
    book = started(flash)
    aim = struct.pack("<fff", 1, 2, 3)
    book.note(5, aim)
    got = after_reset(flash)
    assert (got.state, got.aim) == (5, aim)
    before = flash.operations
    book.note(5, None)  # goes with the next record
    assert flash.operations == before
    book.zero(0, 0)
    assert after_reset(flash).aim is None
    with pytest.raises(ValueError, match="3 bytes for an aim, 12 needed"):
        book.note(5, b"123")


def used(seed: int) -> Nor:
    """Flash with a ring that has gone round, up to a random place."""
    flash = Nor()
    rng = random.Random(seed)
    book = started(flash)
    book.store(FULL)
    for _ in range(rng.randrange(60)):
        book.zero(rng.randrange(-99999, 99999), rng.randrange(-99999, 99999))
    return flash


@STYLES
@pytest.mark.parametrize("seed", range(12))
def test_a_cut_record_leaves_the_old_or_the_new(ragged: bool, seed: int) -> None:
    flash = used(seed)
    old = often(after_reset(flash))
    seen = set()

    def act(book: journal.Journal) -> None:
        book.zero(123, -456)

    def check(got: journal.Journal, whole: bool) -> None:
        assert got.items == FULL
        new = (123, -456, *old[2:])
        after_boot = (123, -456, old[2], old[3], old[4] + 1, min(old[5] + 1, 7))
        assert often(got) in ([new, after_boot] if whole else [old, new])
        seen.add((got.primary, got.secondary) == (123, -456))

    cut_everywhere(flash, ragged, act, check)
    assert seen == {False, True}


@STYLES
@pytest.mark.parametrize("seed", range(8))
def test_counts_are_never_farther_off_than_said(ragged: bool, seed: int) -> None:
    """A motor, and a supply that fails at any time, in flash or between steps; 40 lives each."""
    rng = random.Random(seed)
    flash = used(seed)
    started(flash).zero(0, 0)
    true, doubted, exact, worst = [0, 0], 0, 0, 0
    for _ in range(40):
        flash.budget, flash.ragged = rng.randrange(6000), ragged
        book = journal.Journal(flash)
        book.load()
        doubt = book.doubt
        error = max(abs(true[0] - book.primary), abs(true[1] - book.secondary))
        assert doubt == -1 or error <= doubt
        worst = max(worst, error)
        doubted += doubt > 0
        exact += doubt == 0
        if doubt == -1 or rng.random() < 0.3:
            flash.budget = None
            book.zero(*true)
            flash.budget = rng.randrange(6000)
        offset = (true[0] - book.primary, true[1] - book.secondary)
        try:
            live(book, true, offset, rng)
        except CutError:
            continue
    assert doubted > 5
    assert exact > 1
    assert worst > journal.STRIDE / 2


def live(
    book: journal.Journal, true: list[int], offset: tuple[int, int], rng: random.Random
) -> None:
    """Boot, move and rest until the supply fails; ``true`` follows every step."""
    book.boot()
    here = [book.primary, book.secondary]
    for _ in range(rng.randrange(1, 60)):
        for _ in range(rng.randrange(8)):
            there = [count + rng.randint(-book.stride, book.stride) for count in here]
            book.before_steps(*here, *there)
            part = rng.random()  # the supply may fail amid the steps
            if rng.random() < 0.02:
                there = [a + int(part * (b - a)) for a, b in zip(here, there, strict=True)]
                true[:] = [count + off for count, off in zip(there, offset, strict=True)]
                raise CutError
            here = there
            true[:] = [count + off for count, off in zip(here, offset, strict=True)]
        book.at_rest(*here)
        assert (book.primary, book.secondary) == tuple(here)


def test_the_last_record_saves_the_counts() -> None:
    """A brown-out at any filling of the ring: written at once, without an erasure."""
    flash = Nor()
    started(flash).zero(0, 0)
    here = 0
    for life in range(150):
        book = started(flash)
        assert (book.primary, book.doubt) == (here, 0)
        for _ in range(life % 7):
            book.before_steps(here, 0, here + 900, 0)
            here += 900
        here += 17
        erased, operations = list(flash.erased), flash.operations
        assert book.brown_out(here, 0)
        assert flash.erased == erased
        assert flash.operations == operations + 1
        # The supply did not fail after all: going on is as good.
        if life % 5 == 0:
            book.before_steps(here, 0, here + 1, 0)
            book.at_rest(here, 0)


def test_brown_out_before_boot_says_that_there_is_no_room() -> None:
    book = after_reset(Nor())
    assert not book.brown_out(1, 2)


def test_doubt_adds_up_and_is_cleared() -> None:
    flash = Nor()
    started(flash).zero(0, 0)
    for cuts in range(1, 10):
        book = started(flash)
        assert book.doubt == ((cuts - 1) * journal.STRIDE if cuts < 8 else -1)
        book.before_steps(book.primary, 0, book.primary + 5, 0)
    book = started(flash)
    book.zero(7, 8)
    assert started(flash).doubt == 0


def test_too_many_steps_at_once() -> None:
    book = started(Nor())
    with pytest.raises(ValueError, match="from 0, 0 to 0, 1001: at most 1000 steps at once"):
        book.before_steps(0, 0, 0, 1001)


def test_rest_is_written_once() -> None:
    flash = Nor()
    book = started(flash)
    book.before_steps(0, 0, 5, 5)
    book.at_rest(5, 5)
    before = flash.operations
    for _ in range(5):
        book.at_rest(5, 5)
    assert flash.operations == before


def test_wear_is_even_and_spares_what_is_stored() -> None:
    flash = Nor(blocks=6)
    book = started(flash)
    book.store(FULL)
    for turn in range(5000):
        book.zero(turn, turn)
    ring = flash.erased[2:]
    assert max(ring) - min(ring) <= 1
    records = flash.block_size // journal.RING_SIZE
    assert abs(sum(ring) - 5000 / records) <= len(ring)
    assert flash.erased[:2] == [1, 0]


def test_boots_wear_the_ring_little() -> None:
    """A block erased before a reset is erased again: blank to the eye is not erased for sure."""
    flash = Nor()
    for _ in range(160):
        started(flash)
    records = flash.block_size // journal.RING_SIZE
    assert sum(flash.erased) <= 2 * 160 / records + 1


def test_blocks_are_erased_at_rest() -> None:
    """Seven records of a movement after any rest: none of them waits for an erasure."""
    flash = Nor()
    book = started(flash)
    book.zero(0, 0)
    here = 0
    for _ in range(200):
        erased = list(flash.erased)
        for _ in range(7):
            book.before_steps(here, 0, here + 900, 0)
            here += 900
        assert flash.erased == erased
        book.at_rest(here, 0)
    assert sum(flash.erased) > 50


def test_a_bad_place_in_the_ring_is_passed_over() -> None:
    flash = Nor()
    book = started(flash)
    flash.stuck = 2 * flash.block_size + 5 * journal.RING_SIZE + 6
    for turn in range(100):
        book.zero(0x11223300 + turn, 7)
        assert after_reset(flash).primary == 0x11223300 + turn


def test_a_ring_that_holds_nothing_more() -> None:
    class Worn(Nor):
        worn = False

        def write(self, offset: int, data: bytes) -> None:
            super().write(offset, b"\x55" * len(data) if self.worn else data)

    flash = Worn()
    book = started(flash)
    book.zero(123, 456)
    flash.worn = True
    for _ in range(3):
        with pytest.raises(OSError, match="the ring does not hold what was written; replace"):
            book.zero(1, 2)
    assert (after_reset(flash).primary, after_reset(flash).secondary) == (123, 456)


def test_boots_are_counted_and_a_loop_is_seen() -> None:
    flash = Nor()
    for boots in range(1, journal.BOOT_LIMIT):
        book = started(flash)
        assert (book.boots, book.unhealthy, book.looping) == (boots, boots, False)
    assert started(flash).looping
    for _ in range(5):
        book = started(flash)
    assert book.unhealthy == 7
    book.healthy()
    operations = flash.operations
    book.healthy()
    assert flash.operations == operations
    book = started(flash)
    assert (book.boots, book.unhealthy, book.looping) == (11, 1, False)


@STYLES
def test_many_lives(ragged: bool) -> None:
    """Random operations with random cuts: each reading is the last whole state or the one cut."""
    rng = random.Random(51)
    flash = Nor()
    started(flash).zero(0, 0)
    for life in range(400):
        book = after_reset(flash)
        flash.budget, flash.ragged = rng.randrange(3000), ragged
        allowed = [(dict(book.items), often(book))]
        try:
            for _ in range(20):
                allowed = allowed[-1:]
                changes = {"key_id": struct.pack("<I", life), "stow": rng.randbytes(8)}
                count, state = rng.randrange(-9999, 9999), rng.randrange(9)
                act = rng.randrange(3)
                items, values = allowed[0]
                if act == 0:
                    allowed.append(({**items, **changes}, values))
                    book.store(changes)
                elif act == 1:
                    allowed.append((items, (count, -count, *values[2:])))
                    book.zero(count, -count)
                else:
                    allowed.append((items, (*values[:2], state, None, *values[4:])))
                    book.note(state, None)
        except CutError:
            pass
        got = after_reset(flash)
        assert (got.items, often(got)) in allowed
