"""Awareness messages: when they are sent, what they say, their size, and which are heard."""

from dataclasses import replace

import numpy as np
import pytest
from moving import make_trace, open_town
from pydantic import ValidationError

from flcav.network.awareness import (
    CAM_BITS,
    ELLIPSE,
    LIGHT_BITS,
    VAM_BITS,
    MessageSettings,
    draw_connected,
    find_received,
    find_sending_times,
    message_bytes,
    send_messages,
)
from flcav.network.ledger import Ledger, LedgerEntry, LinkMegabytes
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import raise_walls
from flcav.world.rays.embree import Assembly
from flcav.world.trace import Trace

EXACT = MessageSettings(share=1, position_m=0, heading_deg=0)
TIMES = np.arange(0, 2.01, 0.2)


def drive(speeds: dict[str, float], times: np.ndarray = TIMES) -> Trace:
    """Return cars that head east at these speeds [m/s], 10 m apart to the side."""
    paths = {
        name: np.c_[mps * times, np.full(len(times), 10.0 * row)] for row, (name, mps) in enumerate(speeds.items())
    }
    trace = make_trace(times, paths)
    velocity = trace.velocity + np.array([(mps, 0, 0) for mps in speeds.values()])
    return replace(trace, velocity=velocity)


@pytest.mark.parametrize(
    ("speed", "turn", "gain", "every_s"),
    [
        (0.0, 0.0, 0.0, 1.0),  # nothing changes
        (3.9, 0.0, 0.0, 1.0),  # less than 4 m in a second
        (9.0, 0.0, 0.0, 0.5),  # 4.5 m
        (39.0, 0.0, 0.0, 0.2),
        (60.0, 0.0, 0.0, 0.1),  # no more often than ten times a second
        (1.0, np.radians(21.0), 0.0, 0.2),  # 4.2 degrees
        (1.0, 0.0, 2.0, 0.3),  # 0.6 m/s
    ],
)
def test_a_message_follows_a_change_or_a_second(speed: float, turn: float, gain: float, every_s: float) -> None:
    times = np.arange(0, 3.01, 0.1)
    place = np.c_[speed * times, np.zeros(len(times))]
    sent = find_sending_times(times, place, turn * times, speed + gain * times, 3)
    assert sent[0] == 3
    np.testing.assert_allclose(np.diff(times[sent]), every_s, atol=1e-9)


def test_exact_senders_say_where_they_are_in_the_units_of_the_standard() -> None:
    trace = drive({"car0": 10.0, "car1": 4.0, "parked": 0.0})
    senders = draw_connected(trace, EXACT, "1", "a")
    assert senders.tolist() == [0, 1]  # parked vehicles send nothing
    messages = send_messages(trace, senders, EXACT, "1", "a")
    for sender, mps in ((0, 10.0), (1, 4.0)):
        own = messages[messages.sender == sender]
        assert own.time_s.min() < 0 < own.time_s.max() <= 2.0
        front = np.c_[mps * own.time_s + trace.size[sender, 0] / 2, np.full(len(own), 10.0 * sender)]
        np.testing.assert_allclose(own.front, front, atol=0.0051)
        np.testing.assert_allclose(own.speed, mps, atol=0.4)
        assert np.allclose(own.heading, 0.0)
        assert (own.size - trace.size[sender, :2] >= 0).all()  # rounded up to tenths
        assert (own.size - trace.size[sender, :2] < 0.1).all()
        np.testing.assert_allclose(own.deviation_m, 0.01 / ELLIPSE)  # the standard's least semi-axis
    assert (np.diff(messages[messages.sender == 0].time_s) <= 0.5 + 1e-6).all()


def test_position_errors_are_those_of_the_drive_and_stated() -> None:
    trace = drive({f"car{number}": 20.0 for number in range(150)})
    messages = send_messages(
        trace, draw_connected(trace, EXACT, "1", "a"), MessageSettings(share=1, position_m=1.5), "a"
    )
    off = messages.front - np.c_[20 * messages.time_s + trace.size[0, 0] / 2, 10.0 * messages.sender]
    mean = np.array([off[messages.sender == row].mean(axis=0) for row in range(150)])
    within = np.concatenate([off[messages.sender == row] - mean[row] for row in range(150)])
    assert off.std() == pytest.approx(1.5, rel=0.15)
    assert mean.std() == pytest.approx(1.5 * np.sqrt(1 - 0.04), rel=0.15)
    assert within.std() == pytest.approx(0.3, rel=0.15)
    np.testing.assert_allclose(messages.deviation_m, 1.5, rtol=0.01)
    np.testing.assert_allclose(np.degrees(messages.turn_rad), 0.5, atol=0.06)  # rounded up to tenths of a degree
    inside = (off**2).sum(axis=1) <= (ELLIPSE * 1.5) ** 2
    assert inside.mean() == pytest.approx(0.95, abs=0.05)


def test_phones_of_people_tell_a_place_within_five_seconds_and_no_size() -> None:
    paths = {
        "waits": np.zeros((11, 2)),
        "walks": np.c_[1.5 * TIMES, np.full(11, 4.0)],
        "rides": np.c_[5 * TIMES, [9] * 11],
    }
    trace = make_trace(TIMES, paths, {"waits": ("pedestrian", 0), "walks": ("pedestrian", 0), "rides": ("bicycle", 0)})
    trace = replace(trace, velocity=trace.velocity + np.array([(0, 0, 0), (1.5, 0, 0), (5.0, 0, 0)]))
    assert len(draw_connected(trace, EXACT, "1", "a")) == 0
    how = MessageSettings(share=0, people=1, people_m=1.5, heading_deg=0)
    senders = draw_connected(trace, how, "1", "a")
    assert senders.tolist() == [0, 1, 2]
    messages = send_messages(trace, senders, how, "1", "a")
    gaps = {sender: np.diff(messages.time_s[messages.sender == sender]) for sender in range(3)}
    assert len(gaps[0]) <= 1
    np.testing.assert_allclose(gaps[0], 5.0)
    np.testing.assert_allclose(gaps[1], 2.7)  # 4.05 m
    np.testing.assert_allclose(gaps[2], 0.9)  # 4.5 m
    assert {tuple(size) for size in messages.size.tolist()} == {(0.8, 0.6), (1.8, 0.6)}
    np.testing.assert_allclose(messages.deviation_m, 1.5, rtol=0.01)
    assert set(messages.bytes.tolist()) <= {35 + 44 + 95, 35 + 44 + 95 + 131}
    assert sum(VAM_BITS.values()) == 278  # 35 bytes


def test_a_larger_share_adds_senders_to_those_of_a_smaller_one() -> None:
    trace = drive({f"car{number}": 5.0 for number in range(200)})
    few, half, most, none = (
        set(draw_connected(trace, MessageSettings(share=share), "1", "a")) for share in (0.1, 0.3, 0.6, 0.0)
    )
    assert not none
    assert few < half < most
    assert [len(few), len(half), len(most)] == pytest.approx([20, 60, 120], abs=18)
    assert few != set(draw_connected(trace, MessageSettings(share=0.1), "1", "b"))


def test_sizes_are_those_of_unaligned_per() -> None:
    assert sum(CAM_BITS.values()) == 322  # 41 bytes
    assert LIGHT_BITS == 364
    assert message_bytes(light=False, certified=False) == 41 + 44 + 95
    assert message_bytes(light=True, certified=False) == 86 + 44 + 95
    sent = send_messages(drive({"car": 60.0}), [0], EXACT).bytes
    assert set(sent.tolist()) == {180, 225, 356}  # a certificate each second, light and path twice a second
    assert (sent[:10] == 356).sum() == 1


def test_who_is_near_is_heard_and_who_is_far_behind_houses_is_not() -> None:
    paths = {"me": [0.0, 0.0], "near": [60.0, 0.0], "hidden": [0.0, 140.0], "far": [90000.0, 0.0]}
    trace = replace(make_trace([0.0, 0.2], paths), velocity=np.full((2, 4, 3), 1.0))
    quiet = MessageSettings(share=1, radio=Radio(power_dbm=-10, shadowing=False))
    walls = raise_walls(open_town((0.0, 70.0, 0.0, 60.0, 12.0, 20.0)))
    messages = send_messages(trace, range(4), quiet)

    def heard(how: MessageSettings, around: Assembly | None = walls) -> set[str]:
        got = find_received(messages, trace, "me", around, how)
        return {str(trace.actor[sender]) for sender in messages.sender[got]}

    assert heard(quiet) == {"near"}
    assert heard(quiet, None) == {"near", "hidden"}
    assert heard(MessageSettings(share=1)) == {"near", "hidden"}
    assert heard(MessageSettings(share=1, lost=1)) == set()
    part = find_received(messages, trace, "me", None, MessageSettings(share=1, lost=0.5))
    assert 0 < part.sum() < find_received(messages, trace, "me", None, MessageSettings(share=1)).sum()


@pytest.mark.parametrize(
    "odd", [{"share": 1.1}, {"share": -0.1}, {"position_m": -0.5}, {"people": 1.5}, {"share": float("nan")}]
)
def test_impossible_settings_are_refused(odd: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match=next(iter(odd))):
        MessageSettings.model_validate(odd)


def test_the_sidelink_has_no_budget() -> None:
    book = Ledger(LinkMegabytes(0.0, 0.0))
    for direction in ("down", "up"):
        book.enter(LedgerEntry("edge", "objects", "sidelink", direction, 0, "grid/cav0", 1000))
    assert book.left_mb("wireless") == 0.0
    assert book.used_bytes("sidelink", direction="down") == 1000
