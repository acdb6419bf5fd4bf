"""ROS 2 topics as the wireline between edge servers and the cloud: messages of stage III over DDS.

A request of the cloud to an edge server is published on a topic of that server, and its reply on another one, as
`std_msgs/msg/UInt8MultiArray` with ROS 2's names, types, type hash and quality of service on the wire (the mapping of
`rmw_cyclonedds_cpp`: topic `/a` is `rt/a`, type `pkg/msg/T` is `pkg::msg::dds_::T_`). The data of an array are a Flower
message's records as Flower serialises them; the label of its single dimension is their type. Clients train in this
process. Messages may be kept in a ROS 2 bag: MCAP with the profile of ROS 2, and its metadata.yaml (rosbag2, version
9). Needs the extra `ros`.
"""

import contextlib
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Literal

import yaml
from flwr.app import Message
from flwr.clientapp import ClientApp
from mcap.writer import CompressionType, Writer

from flcav.config import InputError
from flcav.federation.links.in_process import EmbeddedGrid
from flcav.federation.links.ros_names import ROS_NAMESPACE, join_names
from flcav.federation.state import ClientStates
from flcav.federation.trainable import Trainable
from flcav.federation.wire import pack_records, refuse_request, unpack_records
from flcav.interface.wording import format_install_command
from flcav.storage.files import write_bytes

DEFINITION = """std_msgs/MultiArrayLayout layout
uint8[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
STEP_NS = 1_000_000  # between messages, which get consecutive times, since a simulated exchange has no clock
UNIT = {"sec": 0, "nsec": 0}
QUALITY = [  # ROS 2's default: reliable, volatile, keep the last ten
    {
        "history": "keep_last",
        "depth": 10,
        "reliability": "reliable",
        "durability": "volatile",
        "deadline": UNIT,
        "lifespan": UNIT,
        "liveliness": "automatic",
        "liveliness_lease_duration": UNIT,
        "avoid_ros_namespace_conventions": False,
    }
]


class BagWriter:
    """A writer of a ROS 2 bag, a folder with one MCAP file; a context manager.

    The same messages give the same bytes. The metadata, without which a bag cannot be read, are written at the end.
    """

    def __init__(self, folder: Path, kind: str, type_hash: str) -> None:
        """Write messages of the ROS type `kind`, whose definition is `DEFINITION`, to a new folder."""
        self._folder, self._kind, self._hash = folder, kind, type_hash
        self._file = f"{folder.name}_0.mcap"
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()

    def __enter__(self) -> "BagWriter":
        self._folder.mkdir(parents=True)
        self._stream = (self._folder / self._file).open("wb")
        self._writer = Writer(self._stream, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="flcav")
        self._schema = self._writer.register_schema(self._kind, "ros2msg", DEFINITION.encode())
        return self

    def write(self, topic: str, cdr: bytes) -> None:
        """Write a CDR message, which includes its encapsulation header."""
        if topic not in self._channels:
            about = {"offered_qos_profiles": yaml.safe_dump(QUALITY), "topic_type_hash": self._hash}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schema, metadata=about)
        now = self._counts.total() * STEP_NS
        self._writer.add_message(self._channels[topic], log_time=now, publish_time=now, data=cdr)
        self._counts[topic] += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._writer.finish()
        self._stream.close()
        if kind is None:
            write_bytes(self._folder / "metadata.yaml", yaml.safe_dump(self._describe(), sort_keys=False).encode())

    def _describe(self) -> dict[str, object]:
        count = self._counts.total()
        lasts = {"nanoseconds": max(count - 1, 0) * STEP_NS}
        begins = {"nanoseconds_since_epoch": 0}
        topics = [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": self._kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": QUALITY,
                    "type_description_hash": self._hash,
                },
                "message_count": number,
            }
            for topic, number in self._counts.items()
        ]
        file = {"path": self._file, "starting_time": begins, "duration": lasts, "message_count": count}
        return {
            "rosbag2_bagfile_information": {
                "version": 9,
                "storage_identifier": "mcap",
                "duration": lasts,
                "starting_time": begins,
                "message_count": count,
                "topics_with_message_count": topics,
                "compression_format": "",
                "compression_mode": "",
                "relative_file_paths": [self._file],
                "files": [file],
                "custom_data": None,
                "ros_distro": "jazzy",
            }
        }


TYPE, HASH = "std_msgs/msg/UInt8MultiArray", "RIHS01_5687e861b8d307a5e48b7515467ae7a5fc2daf805bd0ce6d8e9e604bade9f385"
RECORDS, FAILED = "flwr.RecordDict", "error"  # labels of the dimension: type of the data
DISCOVERY_S, DELIVERY_S = 20.0, 120.0
MOST_BYTES = 2**31  # bound on a message's data


@dataclass(frozen=True)
class RosTopics:
    """The topics of a federation below a namespace in a DDS domain, by which server and clients exchange messages.

    Every client has the topics NAMESPACE/CLIENT/down, from the server, and NAMESPACE/CLIENT/up. Simultaneous
    federations in one domain need different namespaces. Raises `InputError` for invalid ROS names.
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
        """Return the number of the DDS domain; raises `InputError` where the environment's is invalid."""
        given = os.environ.get("ROS_DOMAIN_ID", "0") if self.domain is None else str(self.domain)
        if not given.isascii() or not given.isdigit():
            raise InputError(f"ROS_DOMAIN_ID '{given}': a number is wanted")
        return int(given)

    def name(self, client: str, way: str) -> str:
        """Return the ROS name of a client's topic; `way` is down or up."""
        return join_names(self.namespace, client, way)

    @contextlib.contextmanager
    def open(
        self,
        clients: Mapping[str, Trainable],
        make_app: Callable[[Mapping[str, Trainable]], ClientApp],
        states: ClientStates,
    ) -> Iterator["TopicGrid"]:
        """Yield the grid of the clients.

        Raises `InputError` where the extra is not installed or two clients have the same topic, OSError where DDS fails
        or the two ends of a topic do not discover each other.
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
    """A topic with one writer and one reader, which belong to two participants of a domain, as in two processes."""

    def __init__(self, name: str, from_: Any, to: Any) -> None:
        """Open both ends of the topic with a ROS name; raises OSError where they do not discover each other.

        Args:
            name: of the topic.
            from_: the participant (cyclonedds) that writes.
            to: the participant that reads.
        """
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic as DdsTopic

        from flcav.federation.links.ros_types import UInt8MultiArray_

        self.name = name
        self._kind = UInt8MultiArray_
        quality = Qos(
            Policy.Reliability.Reliable(max_blocking_time=int(DELIVERY_S * 1e9)),
            Policy.Durability.Volatile,
            Policy.History.KeepLast(10),
            Policy.DataRepresentation(use_cdrv0_representation=True),  # XCDR1, which ROS 2 uses
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
        """Publish an array, and return the label and data that the reader received; raises OSError where DDS fails."""
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
    """Yield the topics down and up by client; the server and every client are participants of the domain."""
    try:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import DomainParticipant
    except ImportError:
        command = format_install_command("ros")
        raise InputError(f"parameters on ROS 2 topics need the extra 'ros': {command}") from None
    found: dict[str, tuple[Topic, Topic]] = {}
    try:
        server = DomainParticipant(topics.number)
        for name in clients:
            participant = DomainParticipant(topics.number)
            found[name] = (
                Topic(topics.name(name, "down"), server, participant),
                Topic(topics.name(name, "up"), participant, server),
            )
    except DDSException as error:
        raise OSError(f"DDS domain {topics.number}: {error}") from None
    yield found


class TopicGrid(EmbeddedGrid):
    """A Flower grid whose messages and replies use topics; the nodes are in this process."""

    def __init__(
        self,
        app: ClientApp,
        names: Sequence[str],
        states: ClientStates,
        wires: Mapping[str, tuple[Topic, Topic]],
        bag: BagWriter | None,
    ) -> None:
        """Register a node per name, with its topics, down and up."""
        super().__init__(app, names, states)
        self._wires, self._bag = wires, bag

    def _deliver(self, message: Message) -> Message:
        """Return a node's reply to a message, both sent by their topics."""
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
            return refuse_request(message, data.decode())
        return Message(unpack_records(data), reply_to=message)
