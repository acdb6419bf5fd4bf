"""The clock of buffered rounds: a schedule by hand, scenes that repeat, and vehicles that are lost and begin again."""

import numpy as np
import pytest
from moving import made_links

from flcav.config import InputError
from flcav.network.clock.buffers import BufferClock, BufferTiming, chain_links
from flcav.network.clock.records import ClientWork
from flcav.network.clock.rounds import RoundRules, time_round

GOOD, NONE = 30.0, -40.0  # dB: 20 Mbit/s of 10 MHz; nothing
NAN = np.nan
TIMES = np.arange(0.0, 41.0)


def trained(**seconds: float) -> list[ClientWork]:
    """Return work whose messages take no time."""
    return [ClientWork(name, 0, each, 0) for name, each in seconds.items()]


def clock(links, work, size: int, **rules) -> BufferClock:
    return BufferClock(links if isinstance(links, list) else [links], work, size, RoundRules(**rules))


def told(buffer: BufferTiming) -> tuple[float, dict[str, int]]:
    return round(buffer.end_s, 6), dict(buffer.versions)


def test_a_schedule_by_hand():
    """Training takes 2, 3 and 7 s, a buffer is of two updates.

    a is ready at 2, b at 3: full at 3, version 1. Both begin again with it: a is ready at 5, b at 6: full at 6,
    version 2. c is ready at 7, with version 0; a at 8: full at 8, version 3. b is ready at 9, with version 2; a, that
    began with version 3, at 10: full at 10, version 4. Both begin again: full at 13, version 5. c, that began at 8 with
    version 3, is ready at 15, as a with version 5: full, version 6. b is ready at 16, with version 5, a at 17.
    """
    own = clock(made_links(TIMES, dict.fromkeys("abc", GOOD)), trained(a=2.0, b=3.0, c=7.0), 2)
    assert [told(own.fill()) for _ in range(4)] == [
        (3.0, {"a": 0, "b": 0}),
        (6.0, {"a": 1, "b": 1}),
        (8.0, {"c": 0, "a": 2}),
        (10.0, {"b": 2, "a": 3}),
    ]
    later = [own.fill() for _ in range(3)]
    assert [told(each) for each in later] == [
        (13.0, {"a": 4, "b": 4}),
        (15.0, {"a": 5, "c": 3}),
        (17.0, {"b": 5, "a": 6}),
    ]
    assert later[1].as_round().clients[1].start_s == 8.0
    assert (later[1].start_s, later[1].number) == (13.0, 6)


def test_a_buffer_of_all_is_a_synchronous_round():
    links = made_links(TIMES, dict.fromkeys("abc", GOOD))
    work = [ClientWork(name, 250_000, each, 500_000) for name, each in zip("abc", (1.0, 2.5, 4.0), strict=True)]
    own = clock(links, work, 3)
    first, second = own.fill(), own.fill()
    alone = {each.client: each for each in time_round(links, work, 1, 0.0, RoundRules())}
    assert {each.client: each for each in first.updates} == alone
    assert (first.versions, second.versions) == (dict.fromkeys("abc", 0), dict.fromkeys("abc", 1))
    assert second.end_s == pytest.approx(2 * first.end_s)


def test_updates_at_the_same_time_fill_buffers_in_the_clients_order():
    own = clock(made_links(TIMES, dict.fromkeys("abc", GOOD)), trained(a=2.0, b=2.0, c=2.0), 2)
    assert [told(own.fill()) for _ in range(3)] == [
        (2.0, {"a": 0, "b": 0}),
        (4.0, {"c": 0, "a": 1}),
        (6.0, {"b": 1, "a": 2}),
    ]


def test_scenes_repeat_and_a_transfer_goes_on_in_the_next():
    """Two scenes of 4 s: the vehicle has 2 MB to send at 20 Mbit/s in the first, and nothing in the second."""
    good, none = made_links(np.arange(5.0), {"a": GOOD}), made_links(np.arange(10.0, 15.0), {"a": NONE})
    links, lasts = chain_links([good, none])
    assert (links.time_s.tolist(), lasts) == ([0, 1, 2, 3, 4, 5, 6, 7], 8.0)
    own = clock([good, none], [ClientWork("a", 0, 0.0, 12_500_000)], 1, outage_s=10.0)
    assert own.fill().end_s == pytest.approx(9.0)  # 4 s of sending, 4 s without a rate, 1 s of sending


def test_a_lost_vehicle_begins_again_when_it_is_back():
    """It leaves at 3 s with 1.25 of 5 MB sent, after 2.5 MB down and 1 s of training, and is back at 6 s."""
    there = np.where((TIMES >= 3) & (TIMES < 6), NAN, GOOD)
    own = clock(made_links(TIMES, {"a": there}), [ClientWork("a", 2_500_000, 1.5, 5_000_000)], 1)
    (found,) = [own.fill()]
    (broken,) = found.broken
    assert (broken.dropped, broken.end_s, broken.uploaded_bytes, broken.round) == ("left the town", 3.0, 1_250_000, 1)
    assert (found.updates[0].start_s, found.end_s) == (6.0, 10.5)
    assert own.fill().broken == ()


def test_out_of_coverage_it_waits_to_begin():
    own = clock(made_links(TIMES, {"a": np.where(TIMES < 5, NONE, GOOD)}), trained(a=1.0), 1)
    assert own.fill().updates[0].start_s == 5.0


def test_while_the_server_is_away_updates_arrive_and_nobody_begins():
    own = clock(made_links(TIMES, dict.fromkeys("ab", GOOD)), trained(a=2.0, b=3.0), 1)
    assert told(own.fill()) == (2.0, {"a": 0})
    own.hold(3.5)
    assert told(own.fill()) == (3.5, {"b": 0})
    assert told(own.fill()) == (5.5, {"a": 2})
    own.hold(1.0)  # is over


def test_what_cannot_be_is_refused():
    links = made_links(TIMES, {"a": GOOD, "b": NONE})
    with pytest.raises(InputError, match="a buffer of 3 updates, and 2 vehicles"):
        clock(links, trained(a=1.0, b=1.0, c=1.0), 3)
    with pytest.raises(InputError, match="no vehicle's update arrives within 410 s"):
        clock(links, [ClientWork("b", 1, 1.0, 1)], 1).fill()
    with pytest.raises(InputError, match="scenes of one instant"):
        chain_links([made_links([0.0], {"a": GOOD})])
