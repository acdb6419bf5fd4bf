"""Messages of stage III on ROS 2 topics, and their bag, as rosbags reads them."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from regression import START, ledger, vehicles
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from flcav.config import InputError
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.links.topics import HASH, RECORDS, TYPE, RosTopics, Topic
from flcav.federation.loop import Schedule, federate
from flcav.federation.wire import unpack_records
from flcav.network.ledger import Ledger

pytest.importorskip("cyclonedds")
SCHEDULE, STORE = Schedule(2, 2, 0.1, 0.1, 4), get_typestore(Stores.ROS2_JAZZY)
DOMAIN = 187  # of these tests alone


@pytest.fixture(autouse=True)
def _on_the_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    interfaces = '<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    peers = '<Discovery><Peers><Peer Address="localhost"/></Peers><ParticipantIndex>auto</ParticipantIndex></Discovery>'
    general = f"<General>{interfaces}<AllowMulticast>false</AllowMulticast></General>"
    monkeypatch.setenv("CYCLONEDDS_URI", f"<CycloneDDS><Domain Id='any'>{general}{peers}</Domain></CycloneDDS>")


def exchange(runtime: RosTopics | None) -> tuple[Any, Ledger]:
    book = ledger()
    air, line = (Account(book, "cloud", "line", link) for link in ("wireless", "wireline"))
    servers = {region: EdgeServer(vehicles(region, 2), 1, air, START) for region in ("grid", "ring")}
    return federate(servers, START, SCHEDULE, line, runtime=runtime).weights, book


def test_a_cloud_round_by_topics_has_the_weights_and_the_ledger_of_one_in_memory(tmp_path: Path):
    plain, book = exchange(None)
    found, carried = exchange(RosTopics("/flcav/line", DOMAIN, tmp_path / "bag"))
    assert all((found[name] == plain[name]).all() for name in START)
    assert carried.entries == book.entries
    with Reader(tmp_path / "bag") as bag:
        about = {each.topic: each for each in bag.connections}
        assert {*about} == {f"/flcav/line/{region}/{way}" for region in ("grid", "ring") for way in ("down", "up")}
        assert {(each.msgtype, each.msgcount, each.digest) for each in about.values()} == {(TYPE, 2, HASH)}
        sizes = []
        for connection, _, raw in bag.messages():
            message: Any = STORE.deserialize_cdr(raw, connection.msgtype)
            (dimension,) = message.layout.dim
            assert (dimension.label, dimension.size) == (RECORDS, len(message.data))
            assert "arrays" in unpack_records(message.data.tobytes())
            sizes.append(len(message.data))
            assert STORE.serialize_cdr(message, TYPE) == raw
    assert sizes == [entry.bytes for entry in carried.entries if entry.link == "wireline"]


def test_a_bag_of_the_same_exchange_has_the_same_bytes(tmp_path: Path):
    for name in ("one", "two"):
        exchange(RosTopics("/flcav/line", DOMAIN, tmp_path / name / "bag"))
    for file in ("bag_0.mcap", "metadata.yaml"):
        assert (tmp_path / "one/bag" / file).read_bytes() == (tmp_path / "two/bag" / file).read_bytes()


def test_on_the_wire_names_type_and_hash_are_those_of_ros():
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.qos import Policy

    assert STORE.hash_rihs01(TYPE) == HASH
    ends = [DomainParticipant(DOMAIN) for _ in range(2)]
    topic = Topic("/flcav/grid/up", *ends)
    watching = DomainParticipant(DOMAIN)
    reader: Any = BuiltinDataReader(watching, BuiltinTopicDcpsPublication)
    until, seen = time.monotonic() + 10, []
    while not seen and time.monotonic() < until:
        seen += [each for each in reader.take(N=100) if each.topic_name == "rt/flcav/grid/up"]
        time.sleep(0.02)
    assert seen[0].type_name == "std_msgs::msg::dds_::UInt8MultiArray_"
    assert Policy.Userdata(f"typehash={HASH};".encode()) in seen[0].qos
    assert Policy.Durability.Volatile in seen[0].qos
    assert topic.carry("a", b"b", None) == ("a", b"b")


def test_a_network_of_the_articles_size_goes_by_a_topic():
    from cyclonedds.domain import DomainParticipant

    ends, data = [DomainParticipant(DOMAIN) for _ in range(2)], bytes(range(256)) * 5274  # 1.35 MB
    topic, began = Topic("/flcav/grid/down", *ends), time.monotonic()
    assert topic.carry(RECORDS, data, None) == (RECORDS, data)
    assert time.monotonic() - began < 10


def test_a_server_that_fails_is_named_with_its_reason():
    from flcav.federation.exchange import ClientFailed

    clients = vehicles("grid", 2)
    clients["grid/cav1"] = replace(clients["grid/cav1"], fail=True)
    clients["grid/cav0"] = replace(clients["grid/cav0"], fail=True)
    with pytest.raises(ClientFailed, match="grid/cav0: RuntimeError\\('no power'\\)"):
        federate(clients, START, SCHEDULE, runtime=RosTopics("/flcav/line", DOMAIN))


def test_what_is_no_name_or_domain_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("flcav", "/1st", "/a b", "/flcav/", "/"):
        with pytest.raises(InputError, match="a ROS name such as"):
            RosTopics(name, DOMAIN)
    with pytest.raises(InputError, match="DDS domain 233: 0 to 232"):
        RosTopics(domain=233)
    with pytest.raises(InputError, match="is there already"):
        RosTopics(bag=tmp_path)
    monkeypatch.setenv("ROS_DOMAIN_ID", "x")
    with pytest.raises(InputError, match="ROS_DOMAIN_ID 'x': a number is wanted"):
        RosTopics()
    twins = {"a/b": vehicles("a", 1)["a/cav0"], "a_b": vehicles("a", 1)["a/cav0"]}
    with pytest.raises(InputError, match="the same ROS name"):
        federate(twins, START, SCHEDULE, runtime=RosTopics(domain=DOMAIN))
