"""ROS 2 topics as the wireline between edge servers and the cloud: messages of stage III, as DDS carries them.

What the cloud sends to an edge server is published on a topic of that server, and its reply on another one, as
`std_msgs/msg/UInt8MultiArray` with ROS 2's names, types, type hash and quality of service on the wire (the mapping of
`rmw_cyclonedds_cpp`: topic `/a` is `rt/a`, type `pkg/msg/T` is `pkg::msg::dds_::T_`). The data of an array are a Flower
message's records as Flower serialises them; the label of its one dimension says what they are. Clients train in this
process. Needs the extra `ros`.
"""

import contextlib
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from flwr.app import Message, RecordDict
from flwr.clientapp import ClientApp
from flwr.common.serde import recorddict_from_proto, recorddict_to_proto
from flwr.proto.recorddict_pb2 import RecordDict as ProtoRecords

from flcav.config import InputError
from flcav.federation.messages.records import refuse
from flcav.federation.runtimes.bag import BagWriter
from flcav.federation.runtimes.embedded import EmbeddedGrid
from flcav.federation.runtimes.ros_names import ROS_NAMESPACE, join_names
from flcav.federation.state import ClientStates
from flcav.federation.trainable import Trainable
from flcav.interface.wording import format_install_command

TYPE, HASH = "std_msgs/msg/UInt8MultiArray", "RIHS01_5687e861b8d307a5e48b7515467ae7a5fc2daf805bd0ce6d8e9e604bade9f385"
RECORDS, FAILED = "flwr.RecordDict", "error"  # labels of the dimension: what the data are
DISCOVERY_S, DELIVERY_S = 20.0, 120.0
MOST_BYTES = 2**31  # of a message's data


@dataclass(frozen=True)
class RosTopics:
    """Topics below a namespace, in a DDS domain, by which a server and its clients exchange messages.

    Each client has the topics NAMESPACE/CLIENT/down, from the server, and NAMESPACE/CLIENT/up. Two federations at once
    in one domain need namespaces of their own. Raises `InputError` for what is no ROS name.
    """

    deployed: ClassVar[Literal[False]] = False
    namespace: str = "/flcav"
    domain: int | None = None  # None: the environment's ROS_DOMAIN_ID, or 0
    bag: Path | None = None  # new folder of a ROS 2 bag with every message; None: none is written

    def __post_init__(self) -> None:
        if not re.match(ROS_NAMESPACE, self.namespace):
            raise InputError(f"namespace '{self.namespace}': a ROS name such as /flcav/weather is wanted")
        if not 0 <= self.number <= 232:
            raise InputError(f"DDS domain {self.number}: 0 to 232 are possible")
        if self.bag is not None and self.bag.exists():
            raise InputError(f"{self.bag}: is there already")

    @property
    def number(self) -> int:
        """Return the number of the DDS domain; raises `InputError` where the environment has none."""
        given = os.environ.get("ROS_DOMAIN_ID", "0") if self.domain is None else str(self.domain)
        if not given.isascii() or not given.isdigit():
            raise InputError(f"ROS_DOMAIN_ID '{given}': a number is wanted")
        return int(given)

    def name(self, client: str, way: str) -> str:
        """Return the ROS name of a client's topic, `way` being down or up."""
        return join_names(self.namespace, client, way)

    @contextlib.contextmanager
    def open(
        self,
        clients: Mapping[str, Trainable],
        make_app: Callable[[Mapping[str, Trainable]], ClientApp],
        states: ClientStates,
    ) -> Iterator["TopicGrid"]:
        """Yield the grid of the clients.

        Raises `InputError` where the extra is not installed or two clients have one topic, OSError where DDS cannot be
        opened or an end does not see the other one.
        """
        names = [*clients]
        if len({self.name(name, "down") for name in names}) < len(names):
            raise InputError("two clients have the same ROS name: letters, digits and _ distinguish them")
        writing = contextlib.nullcontext() if self.bag is None else BagWriter(self.bag, TYPE, HASH)
        with contextlib.ExitStack() as stack:
            wires = stack.enter_context(_open_wires(self, names))
            bag = stack.enter_context(writing)
            grid = TopicGrid(make_app(clients), names, states, wires, bag)
            stack.enter_context(grid)
            yield grid


class Topic:
    """A topic with one writer and one reader, of two participants of a domain, as in two processes."""

    def __init__(self, name: str, from_: Any, to: Any) -> None:
        """Open both ends of the topic with a ROS name; raises OSError where they do not find each other.

        Args:
            name: of the topic.
            from_: the participant (cyclonedds) that writes.
            to: the participant that reads.
        """
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic as DdsTopic

        from flcav.federation.runtimes.ros_types import UInt8MultiArray_

        self.name, self._kind = name, UInt8MultiArray_
        quality = Qos(
            Policy.Reliability.Reliable(max_blocking_time=int(DELIVERY_S * 1e9)),
            Policy.Durability.Volatile,
            Policy.History.KeepLast(10),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"typehash={HASH};".encode()),
        )
        self._reader = DataReader(to, DdsTopic(to, f"rt{name}", UInt8MultiArray_), qos=quality)
        self._writer = DataWriter(from_, DdsTopic(from_, f"rt{name}", UInt8MultiArray_), qos=quality)
        until = time.monotonic() + DISCOVERY_S
        while not (self._writer.get_matched_subscriptions() and self._reader.get_matched_publications()):
            if time.monotonic() > until:
                raise OSError(f"{name}: the ends of the topic do not see each other within {DISCOVERY_S:g} s")
            time.sleep(0.01)

    def carry(self, label: str, data: bytes, bag: BagWriter | None) -> tuple[str, bytes]:
        """Publish an array, and return its label and data as the reader has them; raises OSError as DDS fails."""
        from cyclonedds.core import DDSException
        from cyclonedds.util import duration

        if len(data) >= MOST_BYTES:
            raise OSError(f"{self.name}: a message of {len(data)} bytes is larger than a topic carries")
        message = self._kind.of(label, data)
        if bag is not None:
            bag.write(self.name, message.serialize(use_version_2=False))
        try:
            self._writer.write(message)
            found = next(iter(self._reader.take_iter(timeout=duration(seconds=DELIVERY_S))), None)
        except DDSException as error:
            raise OSError(f"{self.name}: {error}") from None
        if found is None:
            raise OSError(f"{self.name}: a message does not arrive within {DELIVERY_S:g} s")
        return found.read()


@contextlib.contextmanager
def _open_wires(topics: RosTopics, clients: Sequence[str]) -> Iterator[dict[str, tuple[Topic, Topic]]]:
    """Yield each client's topics, down and up; the server is one participant of the domain, each client another."""
    try:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import DomainParticipant
    except ImportError:
        told = f"pip install 'flcav[ros]', or {format_install_command('ros')}"
        raise InputError(f"parameters on ROS 2 topics need the extra 'ros': {told}") from None
    found: dict[str, tuple[Topic, Topic]] = {}
    try:
        server = DomainParticipant(topics.number)
        for name in clients:
            own = DomainParticipant(topics.number)
            found[name] = (
                Topic(topics.name(name, "down"), server, own),
                Topic(topics.name(name, "up"), own, server),
            )
    except DDSException as error:
        raise OSError(f"DDS domain {topics.number}: {error}") from None
    yield found


class TopicGrid(EmbeddedGrid):
    """Flower grid whose messages and replies go by topics; the nodes are in this process."""

    def __init__(
        self,
        app: ClientApp,
        names: Sequence[str],
        states: ClientStates,
        wires: Mapping[str, tuple[Topic, Topic]],
        bag: BagWriter | None,
    ) -> None:
        """Register a node for each of `names`, with its topics, down and up."""
        super().__init__(app, names, states)
        self._wires, self._bag = wires, bag

    def _deliver(self, message: Message) -> Message:
        """Return a node's reply to a message, after both went by their topics."""
        down, up = self._wires[self.names[message.metadata.dst_node_id]]
        sent = message.content
        _, data = down.carry(RECORDS, pack_records(sent), self._bag)
        message.content = unpack_records(data)
        try:
            reply = super()._deliver(message)
        finally:
            message.content = sent
        failed = reply.has_error()
        label, data = up.carry(
            FAILED if failed else RECORDS,
            str(reply.error.reason).encode() if failed else pack_records(reply.content),
            self._bag,
        )
        if label == FAILED:
            return refuse(message, data.decode())
        return Message(unpack_records(data), reply_to=message)


def pack_records(content: RecordDict) -> bytes:
    """Return a message's records as Flower serialises them."""
    return recorddict_to_proto(content).SerializeToString(deterministic=True)


def unpack_records(data: bytes) -> RecordDict:
    """Return the records that `pack_records` serialised."""
    return recorddict_from_proto(ProtoRecords.FromString(data))
