"""FL requests: what is one, and that the registry takes each once."""

import json
from dataclasses import replace

import pytest

from flcav.config import InputError
from flcav.fleet.authority import found_authority, open_registry
from flcav.fleet.fl_request import LARGEST, OLDEST_S, check_age, make_request, parse_request
from flcav.fleet.registry import KEPT_S, MOST, WINDOW_S
from flcav.fleet.status import Asked

REQUEST = make_request("weather", 2.5, 12, (10.0, -3.0))


def test_round_trip():
    assert parse_request(REQUEST.as_bytes()) == REQUEST


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"{}",
        b"[" * LARGEST,
        b"{" + b" " * LARGEST + b"}",
        *(
            json.dumps({**json.loads(REQUEST.as_bytes()), **wrong}).encode()
            for wrong in (
                {"nonce": "0"},
                {"nonce": 1},
                {"task": "../weather"},
                {"task": ""},
                {"loss": float("nan")},
                {"loss": "high"},
                {"time": True},
                {"frames": 0},
                {"frames": 1.5},
                {"x": 1e300},
                {"vehicle": "another"},
            )
        ),
    ],
)
def test_what_is_none(data):
    with pytest.raises(ValueError, match=r"request|nonce|task|finite|frames"):
        parse_request(data)


def test_request_that_cannot_be_sent():
    with pytest.raises(InputError, match="the name of a task is wanted"):
        make_request("no task", 1.0, 1, (0.0, 0.0))


def test_age():
    assert check_age(REQUEST, REQUEST.time + OLDEST_S) is None
    assert check_age(REQUEST, REQUEST.time + OLDEST_S + 1) == f"the request is {OLDEST_S + 1:.0f} s old"
    assert check_age(REQUEST, REQUEST.time - OLDEST_S - 1) == f"the request is {OLDEST_S + 1:.0f} s ahead"


def test_registry_takes_a_nonce_once(tmp_path):
    registry, now = found_authority(tmp_path).registry, 1e9
    about = REQUEST.nonce, REQUEST.as_bytes()
    assert registry.take_request("cav-1", *about, now) is None
    registry.close()
    for vehicle in ("cav-1", "cav-2"):  # from the file
        again = open_registry(tmp_path)
        assert again.take_request(vehicle, *about, now + OLDEST_S) == "a request with this nonce came before"
    assert again.list_requests(5) == [("cav-1", now, REQUEST.as_bytes())]
    assert KEPT_S > 2 * OLDEST_S  # so that a nonce is forgotten when its request is too old alone


def test_many_requests_of_one_vehicle(tmp_path):
    registry, now = found_authority(tmp_path).registry, 1e9

    def take(vehicle, number, when):
        return registry.take_request(vehicle, replace(REQUEST, nonce=f"{number:032x}").nonce, b"", when)

    assert [take("cav-1", number, now) for number in range(MOST)] == [None] * MOST
    assert take("cav-1", MOST, now) == f"{MOST} requests within {WINDOW_S:.0f} s are enough"
    assert take("cav-2", MOST + 1, now) is None
    assert take("cav-1", MOST + 2, now + WINDOW_S + 1) is None
    assert take("cav-1", MOST + 3, now + KEPT_S + 1) is None
    assert len(registry.list_requests(1000)) == 2  # a day later the others are gone


@pytest.mark.parametrize("table", ["requests", "answered"])
def test_registry_of_an_earlier_version(tmp_path, table):
    registry = found_authority(tmp_path).registry
    registry._connection.executescript(f"DROP TABLE {table};")
    registry.close()
    again = open_registry(tmp_path)
    assert (again.list_requests(1), again.list_answered()) == ([], set())


def test_a_request_waits_until_it_is_answered_or_old(tmp_path):
    registry, now = found_authority(tmp_path).registry, 1e9
    sent = [make_request("weather", loss, 3, (0.0, 0.0)) for loss in (1.0, 2.0, 3.0)]
    for number, own in enumerate(sent):
        assert registry.take_request(f"cav-{number % 2}", own.nonce, own.as_bytes(), now + number) is None
    waiting = [(f"cav-{number % 2}", own.as_bytes()) for number, own in enumerate(sent)]
    assert registry.list_open_requests(now - 1) == waiting
    assert registry.list_open_requests(now + 0.5) == waiting[1:]  # the first is too old
    registry.answer_requests([sent[1].nonce], now + 9)
    registry.answer_requests([sent[1].nonce], now + 10)  # as after a stop
    assert open_registry(tmp_path).list_open_requests(now - 1) == [waiting[0], waiting[2]]
    assert registry.list_answered() == {sent[1].nonce}
    assert registry.take_request("cav-1", sent[1].nonce, sent[1].as_bytes(), now + 11) is not None  # nor taken again
    late = make_request("weather", 4.0, 3, (0.0, 0.0))
    assert registry.take_request("cav-2", late.nonce, late.as_bytes(), now + KEPT_S + 9) is None
    assert registry.list_answered() == set()  # forgotten with its request


def test_status_says_whether_a_group_was_formed():
    own = make_request("weather", 2.5, 1, (10.0, -3.0))
    told = "cav-1 asks for federated learning of weather: loss 2.5 on 1 frame held back, at (10, -3) m"
    assert Asked("cav-1", own).describe() == told
    assert Asked("cav-1", own, answered=True).describe() == f"{told}; a group was formed"
