"""The wire format: golden bytes of every message, and arguments that are refused."""

import struct
import tracemalloc
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.carla.server import connections, wire
from flcav.carla.server.wire import Transform

MOST = connections.MOST_ARRAYS
HERE = Transform((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
SIX = "0000803f0000004000004040000080400000a0400000c040"  # of HERE, as float32
BOX = wire.BoundingBox((0.0, 0.0, 0.5), (1.0, 0.5, 0.5), actor_id=7)
DESCRIPTION = wire.Description(3, "vehicle.a.b", (wire.Attribute("color", 5, "1,2,3"),))
ACTOR = wire.ActorRecord(7, 0, DESCRIPTION, BOX, b"\x0e", b"")


def test_header():
    packed = wire.pack_header(wire.Stream.LIDAR, 258, 0.5, HERE)
    assert packed.hex() == "0b00000000000000" + "0201000000000000" + "000000000000e03f" + SIX


def test_state_of_the_world():
    packed = wire.pack_world(2, 1.5, 0.05, [b"AB", b"C"])
    assert packed.hex() == "0200000000000000" + "000000000000f83f" + "cdcc4c3d" + "00" * 16 + b"ABC".hex()


def test_states_of_actors_are_119_bytes():
    motion = ((1.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, 0.0))
    packed = wire.pack_actor(7, HERE, motion, b"\x01\x02")
    vectors = "0000803f" + "00" * 8 + "00" * 8 + "00000040" + "00" * 12
    assert packed.hex() == "07000000" + "01" + SIX + vectors + "0102" + "00" * 52
    assert len(packed) == 119


def test_state_of_a_vehicle():
    control = wire.VehicleControl(1.0, -1.0, 0.5, True, False, True, 2)
    packed = wire.pack_vehicle(control, 2, 30.0, 1, True, 9)
    numbers = "0000803f" + "000080bf" + "0000003f" + "010001" + "02000000" + "0000f041"
    assert packed.hex() == numbers + "01" + "01" + "09000000" + "00"


def test_state_of_a_walker():
    assert (
        wire.pack_walker(wire.WalkerControl((1.0, 0.0, 0.0), 2.0, True)).hex()
        == "0000803f" + "00" * 8 + "00000040" + "01"
    )


def test_state_of_a_light():
    packed = wire.pack_light("x_1", (10.0, 3.0, 2.0), 1.0, 4, True, 2)
    times = "00002041" + "00004040" + "00000040" + "0000803f"
    assert packed.hex() == b"x_1".hex() + "00" * 29 + times + "04000000" + "01" + "02"
    assert len(packed) == 54


def test_image():
    image = np.arange(8, dtype=np.uint8).reshape(1, 2, 4)
    assert wire.pack_image(2, 1, 90.0, image).hex() == "02000000" + "01000000" + "0000b442" + "0001020304050607"


def test_sweep():
    points = np.array([[1, 2, 3, 4]], "<f4")
    packed = wire.pack_lidar(0.5, np.array([0, 1]), points)
    assert packed.hex() == "0000003f" + "02000000" + "00000000" + "01000000" + points.tobytes().hex()


def test_point_of_a_semantic_sweep_is_24_bytes():
    point = np.array([((1.0, 2.0, 3.0), 0.5, 9, 14)], wire.SEMANTIC_POINT)
    assert point.tobytes().hex() == "0000803f0000004000004040" + "0000003f" + "09000000" + "0e000000"


def test_token():
    assert wire.pack_token(5, 2001).hex() == "05000000" + "d107" + "01" + "00" + "00" * 16


def test_records_are_arrays_of_their_fields():
    record = wire.CollisionEvent(ACTOR, ACTOR, (1.0, 2.0, 3.0))
    told = [7, 0, [3, "vehicle.a.b", [["color", 5, "1,2,3"]]]]
    told += [[[0.0, 0.0, 0.5], [1.0, 0.5, 0.5], [0.0, 0.0, 0.0], 7], b"\x0e", b""]
    assert msgpack.unpackb(wire.pack_record(record)) == [told, told, [1.0, 2.0, 3.0]]
    assert wire.pack_record([1.5, 2, 3]).hex() == "93" + "cb3ff8000000000000" + "02" + "03"


@pytest.mark.parametrize(
    ("response", "golden"),
    [
        (wire.succeed("0.9.16"), "9401" + "05" + "c0" + "91" + "92" + "01" + "a6" + b"0.9.16".hex()),
        (wire.DONE, "9401" + "05" + "c0" + "91" + "91" + "c2"),
        (wire.fail("no"), "9401" + "05" + "c0" + "91" + "92" + "00" + "91" + "a2" + b"no".hex()),
    ],
)
def test_replies(response, golden):
    assert wire.pack_reply(5, response).hex() == golden


def test_settings_have_an_optional():
    assert wire.EpisodeSettings(fixed_dt_s=0.05).packed()[2] == [True, 0.05]
    assert wire.EpisodeSettings().packed()[2] == [False]
    assert wire.read(wire.EpisodeSettings, wire.EpisodeSettings(True, fixed_dt_s=0.1).packed()) == wire.EpisodeSettings(
        True, fixed_dt_s=0.1
    )


def test_calls_are_read_one_after_another_and_in_parts():
    message = wire.pack_value([0, 1, "version", [[False]]]) + wire.pack_value([2, "tick_cue", [[True], 4]])
    unpacker = connections.Unpacker()
    unpacker.feed(message[:5])
    assert list(unpacker) == []
    unpacker.feed(message[5:])
    calls = [wire.read_call(each) for each in unpacker]
    assert calls == [wire.Call(1, "version", ()), wire.Call(None, "tick_cue", (4,))]


@pytest.mark.parametrize(
    "message", [[0, 1, "version"], [1, 2, "a", [[]]], {}, 5, [0, "1", "version", [[False]]], [0, 1, "a", []]]
)
def test_other_messages_are_no_calls(message):
    with pytest.raises(wire.WireError):
        wire.read_call(message)


@pytest.mark.parametrize(
    ("message", "told"),
    [
        (
            b"\x92"
            + 2
            * (b"\xdd" + struct.pack(">I", connections.MOST_ARRAYS // 2) + b"\x90" * (connections.MOST_ARRAYS // 2)),
            "arrays",
        ),
        (b"\xdd" + struct.pack(">I", MOST + 1) + b"\xc0" * (MOST + 1), "max_array_len"),
    ],
)
def test_a_call_of_very_many_values_is_refused(message, told):
    unpacker = connections.Unpacker()
    unpacker.feed(message)
    with pytest.raises(ValueError, match=told):
        next(unpacker)


def test_of_an_unfinished_call_only_its_bytes_are_kept():
    """A million empty values would be a list of eight times as many bytes, or of more where they are texts."""
    unpacker = connections.Unpacker()
    begun = b"\x94\x00\x01\xa7version\xdd" + struct.pack(">I", 2_000_000)
    tracemalloc.start()
    for part in (begun, *[b"\xa2ab" * 10_000] * 100):
        unpacker.feed(part)
        assert list(unpacker) == []
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert unpacker.waiting == len(begun) + 3_000_000
    assert held < 1.5 * unpacker.waiting + 1_000_000


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (int, 1.5),
        (int, True),
        (float, "1"),
        (float, float("nan")),
        (float, 1e300),
        (bool, 1),
        (str, b"a"),
        (Transform, [[1, 2, 3]]),
        (Transform, [[1, 2, 3], [1, 2, None]]),
        (int | None, [True]),
        (tuple[int, ...], 5),
        (wire.VehicleControl, [0.0] * 6),
    ],
)
def test_values_of_other_types_are_refused(kind: Any, value: Any):
    with pytest.raises(wire.WireError):
        wire.read(kind, value)


leaves = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5)
trees: Any = st.recursive(leaves | st.binary(max_size=5), lambda inner: st.lists(inner, max_size=5), max_leaves=20)
KINDS = (Transform, wire.Description, wire.EpisodeSettings, wire.WeatherParameters, int | None, wire.BoundingBox)


@given(trees, st.sampled_from(KINDS))
@settings(max_examples=50, deadline=None)
def test_whatever_comes_is_read_or_refused(tree, kind):
    try:
        wire.read(kind, tree)
    except wire.WireError:
        return
    assert isinstance(tree, list)
