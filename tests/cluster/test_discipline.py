"""A clock on a receiver that is right, late, silent, mad, set back, or in another week."""

import asyncio
import math
import re
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.cluster.discipline import DisciplinedClock, DisciplineSettings
from heliotrope.cluster.timekeeping import Quality, Time
from heliotrope.errors import InputError
from heliotrope.links.clock import LEAP_SECONDS, VirtualClock, gps_seconds, run_virtual
from heliotrope.links.link import running
from support.nmea_talk import gga, rmc, sentence, zda

START = datetime(2026, 6, 21, 10, tzinfo=UTC)
LATENCY = 0.12
ALONE = DisciplineSettings(system_tolerance=None)


class Sky:
    """True time, a computer whose oscillator and clock may be off, and a receiver.

    Attributes
    ----------
    off
        What the receiver adds to the true time, in s.
    """

    def __init__(
        self,
        settings: DisciplineSettings | None = None,
        *,
        ppm: float = 0.0,
        system_off: float = 0.0,
        start: datetime = START,
    ) -> None:
        self.true = start
        self.oscillator = VirtualClock(start=start)
        self.oscillator.jump(system_off)
        self.rate = 1.0 + ppm * 1e-6
        self.off = 0.0
        self.kept = DisciplinedClock(self.oscillator, settings)

    def passes(self, seconds: float) -> None:
        self.true += timedelta(seconds=seconds)
        self.oscillator.advance(seconds * self.rate)

    def tell(self, latency: float = LATENCY, said: datetime | None = None) -> None:
        """Let a second pass, at the end of which the receiver has spoken."""
        named = self.true + timedelta(seconds=self.off) if said is None else said
        self.passes(latency)
        self.kept.hear(rmc(named))
        self.passes(1.0 - latency)

    def tells(self, count: int, latency: float = LATENCY) -> None:
        for _ in range(count):
            self.tell(latency)

    def now(self) -> Time:
        return self.kept.time()

    def wrong_by(self) -> float:
        """How far the time told is from the true one, in s."""
        return self.now().gps_s - gps_seconds(self.true)


def named_in(problem: str) -> float:
    """Return how far the computer's clock is off, as a problem says it, in s."""
    found = re.fullmatch(r"the computer's clock is ([+-]\S+) s from the receiver, more .*", problem)
    assert found is not None, problem
    return float(found[1])


def test_a_receiver_is_believed_after_a_while_and_its_time_is_within_its_bound() -> None:
    sky = Sky()
    assert (sky.now().quality, sky.now().error) == ("none", math.inf)
    assert "no time has come" in sky.kept.problem
    sky.tells(2)
    assert sky.now().quality == "none"
    assert "not believed yet" in sky.kept.problem
    sky.tells(4)
    now = sky.now()
    assert (now.quality, now.jumped, sky.kept.problem) == ("gps", False, "")
    assert abs(sky.wrong_by()) <= now.error <= 0.26
    assert now.utc_s == pytest.approx(sky.true.timestamp(), abs=now.error)
    assert sky.kept.system_ahead == pytest.approx(0.0, abs=now.error)


@pytest.mark.parametrize("talk", [lambda t: gga(t) + zda(t), lambda t: rmc(t) + gga(t) + zda(t)])
def test_other_sentences_do_as_well(talk) -> None:  # type: ignore[no-untyped-def]
    sky = Sky()
    for _ in range(6):
        sky.kept.hear(talk(sky.true))
        sky.passes(1.0)
    assert sky.now().quality == "gps"
    assert sky.kept.statistics.fixes == 6


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["quick", "late", "silent", "no fix", "rubbish"]), st.floats(0.0, 1.0)
        ),
        max_size=60,
    ),
    st.floats(-100.0, 100.0),
    st.floats(0.0, 0.45),
)
@settings(max_examples=120, deadline=None)
def test_the_bound_holds_whatever_comes_late_or_not_at_all(
    events: list[tuple[str, float]], ppm: float, quickest: float
) -> None:
    """The quickest of eight sentences is within the latency; all others are as late as they are.

    The oscillator is off by what the settings allow.
    """
    sky = Sky(ppm=ppm)
    sky.tells(6, quickest)
    for number, (event, late) in enumerate(events):
        before = sky.now()
        if event == "quick" or number % 8 == 7:
            sky.tell(quickest)
        elif event == "late":
            sky.tell(quickest + late * (0.99 - quickest))
        else:
            sky.kept.hear({"silent": b"", "no fix": rmc(sky.true, "V")}.get(event, b"$GP\xff*00\r"))
            sky.passes(100.0 * late)
        now = sky.now()
        assert not now.jumped
        if now.quality != "none":
            assert abs(sky.wrong_by()) <= now.error + 1e-6
            assert now.error <= sky.kept._settings.largest_error
        if event == "silent" and late > 0.06 and number % 8 != 7:
            assert now.quality in ("holdover", "none")
            assert now.error > before.error or before.error == math.inf


def test_holdover_grows_by_the_drift_and_ends_at_the_limit() -> None:
    chosen = DisciplineSettings(drift_ppm=100.0, largest_error=1.0)
    sky = Sky(chosen, ppm=90.0)
    sky.tells(6)
    first = sky.now().error
    sky.passes(1000.0)
    now = sky.now()
    assert now.quality == "holdover"
    assert now.error == pytest.approx(first + 1000.0 * 100e-6, abs=1e-3)
    assert abs(sky.wrong_by()) <= now.error
    assert "no new time for 100" in sky.kept.problem
    sky.passes((1.0 - now.error) / 100e-6 - 10.0)
    assert sky.now().quality == "holdover"
    sky.passes(20.0)
    assert (sky.now().quality, sky.now().error) == ("none", math.inf)
    # It is believed again only as at the beginning, and then it is no jump.
    sky.tell()
    assert sky.now().quality == "none"
    sky.tells(5)
    assert (sky.now().quality, sky.now().jumped) == ("gps", False)


@pytest.mark.parametrize("status", [("V", "N"), ("A", "E")])
def test_a_lost_fix_is_holdover_and_says_so(status: tuple[str, str]) -> None:
    sky = Sky()
    sky.tells(6)
    for _ in range(7):
        sky.kept.hear(rmc(sky.true, *status))
        sky.passes(1.0)
    assert sky.now().quality == "holdover"
    assert "no fix" in sky.kept.problem
    assert sky.kept.statistics.no_fix == 7


def test_a_receiver_that_stands_still_is_holdover() -> None:
    sky = Sky()
    sky.tells(6)
    stands = sky.true
    for _ in range(1000):
        sky.tell(said=stands)
        assert abs(sky.wrong_by()) <= sky.now().error
    assert sky.now().quality == "holdover"
    assert f"the last was {stands:%Y-%m-%d %H:%M:%S} UTC" in sky.kept.problem
    # Twice the same sentence over and over, a little later each time, is no better.
    for second in range(500):
        sky.tell(said=stands + timedelta(seconds=0.01 * second))
    assert sky.now().quality == "holdover"
    assert sky.kept.statistics.jumps == 0


@pytest.mark.parametrize("off", [-86400.0, -3.0, 3.0, 3600.0])
def test_a_receiver_that_jumps_against_both_clocks_is_not_followed(off: float) -> None:
    sky = Sky()
    sky.tells(6)
    sky.off = off
    for _ in range(600):
        sky.tell()
        assert not sky.now().jumped
        assert abs(sky.wrong_by()) <= sky.now().error
    assert sky.now().quality == "holdover"
    assert named_in(sky.kept.problem) == pytest.approx(-off, abs=0.3)
    sky.off = 0.0
    sky.tell()
    assert sky.now().quality == "gps"


def test_without_a_second_opinion_the_receiver_has_to_insist() -> None:
    sky = Sky(ALONE, system_off=-1e6)
    sky.tells(6)
    assert sky.now().quality == "gps"
    sky.off = 3.0
    sky.tells(50)
    assert (sky.now().quality, sky.now().jumped) == ("holdover", False)
    assert "the receiver is +3.0 s from the time kept" in sky.kept.problem
    sky.tells(15)
    assert (sky.now().quality, sky.now().jumped) == ("gps", True)
    assert sky.wrong_by() == pytest.approx(3.0, abs=sky.now().error)
    assert sky.kept.statistics.jumps == 1
    sky.tells(12)
    assert not sky.now().jumped


def test_where_the_computer_sides_with_the_receiver_it_is_followed_soon() -> None:
    sky = Sky(system_off=0.0)
    sky.off = -1.9  # both were wrong, as far as the tolerance lets pass
    sky.tells(6)
    assert sky.now().quality == "gps"
    sky.off = 5.0
    sky.oscillator.jump(5.0)
    sky.tells(8)
    assert sky.now().quality == "holdover", "who was set just now is no witness"
    sky.tells(8)
    assert (sky.now().quality, sky.now().jumped) == ("gps", True)


@pytest.mark.parametrize("off", [-10.0, 10.0])
def test_at_first_the_computers_clock_must_agree(off: float) -> None:
    sky = Sky(system_off=off)
    sky.tells(120)
    assert (sky.now().quality, sky.now().error) == ("none", math.inf)
    assert named_in(sky.kept.problem) == pytest.approx(off, abs=0.3)
    sky.oscillator.jump(-off)
    sky.tells(6)
    assert (sky.now().quality, sky.kept.problem) == ("gps", "")


def test_late_sentences_with_pauses_between_do_not_insist() -> None:
    sky = Sky()
    sky.tells(6)
    for _ in range(12):
        sky.tells(3, latency=0.99)
        sky.passes(7.0)
    assert (sky.now().quality, sky.now().jumped) == ("holdover", False)
    assert abs(sky.wrong_by()) <= sky.now().error


def test_a_computer_that_is_set_changes_nothing_while_the_receiver_goes_on() -> None:
    sky = Sky()
    sky.tells(6)
    sky.oscillator.jump(3600.0)
    sky.tells(60)
    assert (sky.now().quality, sky.now().jumped) == ("gps", False)
    assert abs(sky.wrong_by()) <= sky.now().error
    assert sky.kept.system_ahead == pytest.approx(3600.0, abs=0.3)


@given(st.lists(st.floats(-1e5, 1e5), min_size=1, max_size=30))
@settings(max_examples=60, deadline=None)
def test_a_mad_receiver_moves_nothing(offs: list[float]) -> None:
    sky = Sky(ALONE)
    sky.tells(6)
    for off in offs:
        # 0.9 s apart at least, so that no two of them make a claim.
        sky.tell(said=sky.true + timedelta(seconds=math.copysign(max(abs(off), 3.0), off)))
        sky.tell(said=sky.true - timedelta(seconds=2e5 + abs(off)))
        assert abs(sky.wrong_by()) <= sky.now().error
        assert not sky.now().jumped


@pytest.mark.parametrize("step", [2.0, -2.0, 1e4])
def test_a_receiver_that_is_mad_from_the_start_is_never_believed(step: float) -> None:
    sky = Sky(ALONE)
    for number in range(100):
        sky.tell(said=START + timedelta(days=1.0, seconds=step * number))
    assert sky.now().quality == "none"


def test_two_times_are_too_few() -> None:
    sky = Sky(ALONE)
    sky.tell()
    sky.passes(3.0)
    sky.tell()
    assert sky.now().quality == "none"
    sky.tell()
    assert sky.now().quality == "gps"


def test_the_quickest_of_the_first_sentences_decides() -> None:
    sky = Sky()
    sky.tell(latency=0.58)  # beyond what is allowed: a port that has just been opened
    sky.tells(5, latency=0.09)
    now = sky.now()
    assert now.quality == "gps"
    assert abs(sky.wrong_by()) <= now.error
    assert now.error == pytest.approx(0.255, abs=0.001)


def test_a_receiver_that_runs_away_slowly_takes_the_time_no_further_than_its_latency() -> None:
    sky = Sky(ALONE)
    sky.tells(6)
    for _ in range(40):
        sky.off += 0.05
        sky.tell()
        assert abs(sky.wrong_by()) <= sky.kept._settings.latency
    assert sky.now().quality == "holdover"


def test_the_last_time_that_can_be_told_is_no_error() -> None:
    sky = Sky(ALONE, start=datetime(2099, 12, 31, 23, 59, 50, tzinfo=UTC))
    for _ in range(9):
        sky.kept.hear(gga(sky.true) + zda(sky.true))
        sky.passes(1.0)
    assert sky.now().quality == "gps"
    sky.passes(1e6)
    assert sky.now().utc_s == pytest.approx(sky.true.timestamp(), abs=1.0)


@pytest.mark.parametrize("weeks", [1024, 2048])
def test_a_receiver_before_a_rollover_tells_the_right_time(weeks: int) -> None:
    sky = Sky()
    for _ in range(6):
        named = sky.true - timedelta(weeks=weeks)
        sky.kept.hear(gga(named) + zda(named))
        sky.passes(1.0)
    assert sky.now().quality == "gps"
    assert abs(sky.wrong_by()) <= sky.now().error
    assert sky.kept.statistics.rolled == 6


def test_a_leap_second_of_the_table_is_no_step(monkeypatch: pytest.MonkeyPatch) -> None:
    midnight = datetime(2026, 7, 1, tzinfo=UTC)
    table = (*LEAP_SECONDS, (midnight, 19))
    sky = Sky(start=midnight - timedelta(seconds=8))

    def across() -> None:
        for second in range(20):
            if second == 8:  # 23:59:60
                sky.kept.hear(sentence("GNRMC,235960.00,A,2830.0,S,02100.0,E,0,,300626,,,A"))
            else:
                late = timedelta(seconds=1 if second > 8 else 0)
                sky.kept.hear(rmc(midnight + timedelta(seconds=second - 8) - late))
            sky.passes(1.0)

    monkeypatch.setattr("heliotrope.links.clock.LEAP_SECONDS", table)
    across()
    now = sky.now()
    assert (now.quality, now.jumped) == ("gps", False)
    assert now.utc_s == pytest.approx(midnight.timestamp() + 11.0, abs=now.error)
    assert sky.kept.statistics.accepted >= 15


def test_a_leap_second_that_the_table_lacks_is_a_jump_after_insisting() -> None:
    sky = Sky()
    sky.tells(6)
    sky.off = -1.0
    sky.oscillator.jump(-1.0)  # NTP knew
    sky.tells(50)
    assert sky.now().quality == "holdover"
    sky.tells(15)
    assert (sky.now().quality, sky.now().jumped) == ("gps", True)


def test_what_a_stalled_computer_reads_in_a_heap_moves_nothing() -> None:
    sky = Sky()
    sky.tells(6)
    heap = b""
    for _ in range(7):
        heap += rmc(sky.true)
        sky.passes(1.0)
    sky.passes(LATENCY)
    sky.kept.hear(heap)
    assert abs(sky.wrong_by()) <= sky.now().error
    sky.passes(1.0 - LATENCY)
    sky.tells(2)
    assert (sky.now().quality, sky.now().jumped) == ("gps", False)


def test_a_wrong_baud_rate_is_guessed_from_what_comes() -> None:
    sky = Sky()
    for _ in range(20):
        sky.kept.hear(bytes(range(128, 192)))
        sky.passes(1.0)
    assert "1280 bytes came" in sky.kept.problem
    assert "baud rate" in sky.kept.problem


def test_it_works_in_virtual_time_as_a_time_keeper_of_a_cluster() -> None:
    class Simulated:
        """A receiver of a simulation: the disciplined clock, and sentences once a second."""

        def __init__(self, clock: VirtualClock) -> None:
            self.kept, self.clock, self.over = DisciplinedClock(clock), clock, False

        async def run(self) -> None:
            while not self.over:
                self.kept.hear(rmc(self.clock.utc()))
                await asyncio.sleep(1.0)

        async def close(self) -> None:
            self.over = True

    async def main(clock: VirtualClock) -> Quality:
        receiver = Simulated(clock)
        async with running(receiver):
            await asyncio.sleep(10.0)
            return receiver.kept.time().quality

    assert run_virtual(main) == "gps"


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"latency": 0.0}, "latency is 0.0"),
        ({"drift_ppm": -1.0}, "drift_ppm is -1.0"),
        ({"fresh": math.nan}, "fresh is nan"),
        ({"latency": 2.0}, "must be above 1.01 s"),
        ({"largest_error": math.inf}, "largest_error is inf"),
        ({"system_tolerance": 0.0}, "system_tolerance is 0.0 s"),
    ],
)
def test_settings_that_cannot_be_are_refused(values: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        DisciplineSettings(**values)
