"""Which frames act: duplicate, late, replayed, expired, foreign ones do not (invariants 4, 5)."""

import hashlib
import random

import pytest

from heliotrope.lcu import messages, ticks, wire
from heliotrope.lcu.sender import Sender

KEY = b"a key of sixteen"
NOW = 1_480_000_000
TOKEN = 77


def sha256(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


class Ends:
    """A sender and a local controller at address 5, and what passes between them."""

    def __init__(self, edition: int = 0) -> None:
        self.sender = Sender(0, 100, sha256)
        self.gate = wire.Gate(sha256, KEY, edition)
        self.tick = 0

    def judge(self, raw: bytes, now_s: int | None = NOW) -> int:
        (frame,) = wire.Reader().feed(raw)
        return self.gate.judge(frame, self.tick, now_s)

    def track(self, token: int = TOKEN, expires_s: int = NOW + 5) -> bytes:
        return self.sender.frame(5, "TRACK", token, expires_s)

    def stow_counts(self, edition: int, key: bytes = KEY) -> bytes:
        return self.sender.frame(5, "SET_STOW", TOKEN, NOW + 5, edition, 1, 2, key=key)


@pytest.fixture
def ends() -> Ends:
    ends = Ends()
    assert ends.judge(ends.sender.session(TOKEN)) == messages.DONE
    return ends


def test_safety_and_questions_pass_without_anything() -> None:
    ends = Ends()
    for name in ("DEFOCUS", "STOW", "QUERY_STATUS", "QUERY_STEPS"):
        raw = wire.encode(wire.Frame(5, 4711, 9, messages.NUMBER_OF[name], b""))
        for _ in range(3):
            assert ends.judge(raw, None) == messages.DONE
    assert ends.gate.replay.epoch == -1


def test_nothing_else_passes_before_a_session() -> None:
    ends = Ends()
    assert ends.judge(ends.track()) == messages.DUPLICATE
    assert ends.judge(ends.sender.frame(5, "SUN", *[0] * 7)) == messages.DUPLICATE
    assert ends.judge(ends.stow_counts(1)) == messages.DUPLICATE
    assert ends.judge(ends.sender.session(TOKEN)) == messages.DONE
    assert ends.judge(ends.track()) == messages.DONE


@pytest.mark.parametrize(
    ("token", "expires_s", "now_s", "result"),
    [
        (TOKEN, NOW, NOW, messages.DONE),
        (TOKEN + 1, NOW, NOW, messages.REFUSED_AUTHORITY),
        (0, NOW, NOW, messages.REFUSED_AUTHORITY),
        (TOKEN, NOW - 1, NOW, messages.EXPIRED),
        (TOKEN, NOW, None, messages.EXPIRED),
        (TOKEN, NOW + wire.HORIZON_S + 1, NOW, messages.EXPIRED),
    ],
)
def test_token_and_expiry(
    ends: Ends, token: int, expires_s: int, now_s: int | None, result: int
) -> None:
    assert ends.judge(ends.track(token, expires_s), now_s) == result


def test_token_zero_is_nobodys(ends: Ends) -> None:
    assert ends.judge(ends.sender.session(0)) == messages.DONE
    assert ends.judge(ends.track(token=0)) == messages.REFUSED_AUTHORITY


def test_answers_and_unknown_messages_do_not_act(ends: Ends) -> None:
    for number, payload in ((0xEE, b""), (messages.NUMBER_OF["STEPS"], bytes(16))):
        raw = wire.encode(wire.Frame(5, 0, 9, number, payload))
        assert ends.judge(raw) == messages.BAD_VALUE
    aim = wire.Frame(5, 0, 9, messages.NUMBER_OF["AIM"], bytes(8) + b"\xff" * 12)  # NaN
    assert ends.judge(wire.encode(aim)) == messages.BAD_VALUE


def test_commands_of_another_address_do_not_act(ends: Ends) -> None:
    ends.sender.address = 9
    assert ends.judge(ends.track()) == messages.REFUSED_AUTHORITY
    assert ends.judge(ends.sender.session(TOKEN)) == messages.REFUSED_AUTHORITY


def test_a_duplicate_acts_once(ends: Ends) -> None:
    raw = ends.track()
    assert [ends.judge(raw) for _ in range(3)] == [messages.DONE] + [messages.DUPLICATE] * 2


def test_an_overtaken_command_does_not_act(ends: Ends) -> None:
    late, last = ends.track(), ends.track()
    assert ends.judge(last) == messages.DONE
    assert ends.judge(late) == messages.DUPLICATE


def test_half_the_range(ends: Ends) -> None:
    start = ends.sender.count
    for ahead, result in ((0x7FFF, messages.DONE), (0x8000, messages.DUPLICATE)):
        ends.sender.count = start + ahead - 1
        assert ends.judge(ends.track()) == result
        ends.gate.replay.count = start


def test_sequences_wrap(ends: Ends) -> None:
    """300,000 frames, of which half are lost and a tenth come twice."""
    rng = random.Random(21)
    replay, taken = ends.gate.replay, 0
    for count in range(2, 300_002):
        if rng.random() < 0.5:
            assert replay.fresh(count & 0xFFFF, 0)
            taken += 1
            assert rng.random() > 0.1 or not replay.fresh(count & 0xFFFF, 0)
    assert taken > 140_000
    assert replay.count in (300_000, 300_001)


def test_silence_asks_for_a_session(ends: Ends) -> None:
    ends.tick = wire.SILENCE_MS - 1
    assert ends.judge(ends.track()) == messages.DONE
    ends.tick = ticks.add(ends.tick, wire.SILENCE_MS)
    # 40,000 frames went by unheard: the sequence alone would call the next one old.
    ends.sender.count += 40_000
    assert not ends.gate.replay.look(ends.tick)
    assert ends.judge(ends.track()) == messages.DUPLICATE
    assert ends.judge(ends.sender.session(TOKEN)) == messages.DONE
    assert ends.judge(ends.track()) == messages.DONE


def test_silence_does_not_take_old_sessions(ends: Ends) -> None:
    old = ends.sender.session(TOKEN)
    new = ends.sender.session(TOKEN)
    assert ends.judge(new) == messages.DONE
    ends.tick = 2 * wire.SILENCE_MS
    assert ends.judge(old) == messages.DUPLICATE
    assert ends.judge(new) == messages.DUPLICATE
    assert ends.judge(ends.track()) == messages.DUPLICATE


def test_a_restarted_sender_is_heard_at_once_and_its_old_frames_are_not(ends: Ends) -> None:
    ends.sender.count += 30_000
    old = ends.sender.session(TOKEN)
    assert ends.judge(old) == messages.DONE
    late_session, late = ends.sender.session(TOKEN), ends.track()
    ends.sender = Sender(0, 160, sha256)
    assert ends.judge(ends.sender.session(TOKEN + 1)) == messages.DONE
    assert ends.judge(ends.track(TOKEN + 1)) == messages.DONE
    assert ends.judge(late_session) == messages.DUPLICATE
    assert ends.judge(late) in (messages.REFUSED_AUTHORITY, messages.DUPLICATE)


def test_epochs_wrap(ends: Ends) -> None:
    ends.gate.replay.epoch = 2**32 - 1
    ends.sender = Sender(0, 3, sha256)
    assert ends.judge(ends.sender.session(TOKEN)) == messages.DONE
    ends.sender = Sender(0, 2**32 - 1, sha256)
    assert ends.judge(ends.sender.session(TOKEN)) == messages.DUPLICATE


def test_a_used_up_count_begins_an_epoch(ends: Ends) -> None:
    ends.sender.count = 0xFFFEFFF0
    for _ in range(200):
        assert ends.judge(ends.sender.session(TOKEN)) == messages.DONE
        assert ends.judge(ends.track()) == messages.DONE
    assert ends.sender.epoch == 101
    assert ends.sender.count < 400


def test_stored_messages_need_key_and_edition(ends: Ends) -> None:
    assert ends.judge(ends.stow_counts(1, b"another")) == messages.REFUSED_KEY
    assert ends.gate.edition == 0
    assert ends.judge(ends.stow_counts(3)) == messages.DONE
    assert ends.gate.edition == 3
    for edition in (3, 2, 0):
        assert ends.judge(ends.stow_counts(edition)) == messages.DUPLICATE
    assert ends.judge(ends.stow_counts(4)) == messages.DONE


def test_without_key_or_hash_nothing_is_stored(ends: Ends) -> None:
    raw = ends.stow_counts(1)
    for gate in (wire.Gate(), wire.Gate(sha256), wire.Gate(None, KEY)):
        gate.replay.session(100, 0, 1, 0)
        gate.token = TOKEN
        (frame,) = wire.Reader().feed(raw)
        assert gate.judge(frame, 0, NOW) == messages.REFUSED_KEY


def test_recorded_traffic_sets_nothing_again_after_a_reset(ends: Ends) -> None:
    """The clock, too, is set back by the recording: only the edition stands against it."""
    session, stored = ends.sender.session(TOKEN), ends.stow_counts(1)
    assert [ends.judge(raw) for raw in (session, stored)] == [messages.DONE] * 2
    reset = Ends(edition=ends.gate.edition)
    assert [reset.judge(raw) for raw in (session, stored)] == [messages.DONE, messages.DUPLICATE]


class Network(Ends):
    """Loses, repeats, delays frames and is cut; its sender starts anew now and then."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.rng = random.Random(seed)
        self.passed_ms = 0
        self.token = TOKEN
        self.sent: list[tuple[int, int]] = []  # epoch and count of each command
        self.air: list[tuple[int, bytes]] = []  # when it comes, what
        self.acted: list[int] = []

    def now_s(self) -> int:
        return NOW + self.passed_ms // 1000

    def wait(self, span_ms: int) -> None:
        self.passed_ms += span_ms
        self.tick = ticks.add(0, self.passed_ms)

    def restart(self) -> None:
        self.token += 1
        self.sender = Sender(0, self.sender.epoch + self.rng.randint(1, 99), sha256)

    def send(self, step: int) -> None:
        if step % 7 == 0:
            late = self.rng.choice((0, 0, 0, 500))
            self.air.append((self.passed_ms + late, self.sender.session(self.token)))
            return
        expires_s = self.now_s() + self.rng.randint(1, wire.HORIZON_S)
        raw = self.sender.frame(5, "GOTO", self.token, expires_s, len(self.sent), 0)
        self.sent.append((self.sender.epoch, self.sender.count))
        for _ in range(self.rng.choice((0, 1, 1, 1, 1, 2))):
            late = self.rng.choice((0, 0, 0, 100, 2000, 60_000))
            self.air.append((self.passed_ms + late, raw))

    def deliver(self) -> None:
        due = [raw for when, raw in self.air if when <= self.passed_ms]
        self.air = [item for item in self.air if item[0] > self.passed_ms]
        self.rng.shuffle(due)
        for raw in due:
            (frame,) = wire.Reader().feed(raw)
            result = self.gate.judge(frame, self.tick, self.now_s())
            if result == messages.DONE and frame.name == "GOTO":
                values = frame.values()
                assert values is not None
                self.acted.append(values[2])


@pytest.mark.parametrize("seed", range(12))
def test_on_a_bad_network_every_command_acts_at_most_once_and_in_order(seed: int) -> None:
    net = Network(seed)
    for step in range(3000):
        net.wait(net.rng.choice((1, 20, 300)))
        if net.rng.random() < 0.003:
            net.restart()
        if net.rng.random() < 0.002:  # cut for a minute, in which others get their commands
            net.sender.count += net.rng.randrange(38_000)
            net.wait(60_000)
        net.send(step)
        net.deliver()
    assert net.acted == sorted(set(net.acted))
    assert [net.sent[number] for number in net.acted] == sorted(net.sent[n] for n in net.acted)
    assert len(net.acted) > 500


def test_no_command_lives_until_the_sequence_comes_round() -> None:
    shortest = len(wire.encode(wire.Frame(5, 0, 1, messages.NUMBER_OF["STOW"], b"")))
    fastest = 115200 / 10 / shortest  # frames a second
    assert fastest * (wire.HORIZON_S + 1) < 0x8000
    assert fastest * wire.SILENCE_MS / 1000 < 0x8000 / 2
