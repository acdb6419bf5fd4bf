"""What the proxy counts by vehicle: who came in anew, and who may have lost a message."""

import httpx
import pytest

from flcav.fleet.proxy import FleetProxy
from flcav.fleet.traffic import Crossed, ProxyTraffic, read_traffic


@pytest.mark.parametrize(
    ("call", "counted"),
    [
        ("pull-object", Crossed(10, 20, content_up=1, content_down=2, calls=1)),
        ("pull-messages", Crossed(10, 20, other_up=1, other_down=2, calls=1)),
    ],
)
def test_bytes_are_counted_once_and_begin_at_none(call, counted, tmp_path):
    traffic = ProxyTraffic()
    traffic.count("cav-1", call, 1, 2, (10, 20), 200)
    traffic.save(tmp_path)
    assert read_traffic(tmp_path).vehicles["cav-1"] == counted
    names = ("socket_up", "socket_down", "content_up", "content_down", "other_up", "other_down", "release_up")
    assert not any(getattr(Crossed(), name) for name in (*names, "release_down", "calls", "activations", "lost"))


@pytest.mark.parametrize(
    ("call", "status", "activations", "lost"),
    [
        ("activate-node", 200, 1, 0),
        ("activate-node", 401, 0, 0),
        ("confirm-message-received", 200, 0, 0),
        ("confirm-message-received", 500, 0, 1),
        ("push-object", 500, 0, 1),
        ("pull-messages", 500, 0, 0),
    ],
)
def test_losses(call, status, activations, lost, tmp_path):
    traffic = ProxyTraffic()
    traffic.count("cav-1", call, 1, 2, (10, 20), status)
    traffic.save(tmp_path)
    own = read_traffic(tmp_path).vehicles["cav-1"]
    assert (own.activations, own.lost) == (activations, lost)


def test_answers_that_reach_nobody_and_a_proxy_that_begins_anew_may_lose_a_message(tmp_path):
    traffic = ProxyTraffic()
    traffic.count("cav-1", "pull-messages", 1, 2, (10, 20), 200)
    traffic.count("cav-2", "pull-messages", 1, 2, (10, 20), 200, gone=True)
    assert [own.lost for own in traffic.vehicles.values()] == [0, 1]
    traffic.save(tmp_path)
    begun = FleetProxy(httpx.AsyncClient(), tmp_path)
    assert [own.lost for own in begun._traffic.vehicles.values()] == [1, 2]
