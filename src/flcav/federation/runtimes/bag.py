"""ROS 2 bags of one type of messages: MCAP with the profile of ROS 2, and its metadata.yaml (rosbag2, version 9)."""

from collections import Counter
from pathlib import Path
from types import TracebackType

import yaml
from mcap.writer import CompressionType, Writer

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
STEP_NS = 1_000_000  # between messages: they are numbered, since a simulated exchange has no time of its own
UNIT = {"sec": 0, "nsec": 0}
QUALITY = [  # reliable, volatile, the last ten: the default of ROS 2
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
    """A ROS 2 bag that is being written: a folder with one MCAP file; a context manager.

    The same messages give the same bytes. The metadata, without which no bag is read, are written at the end.
    """

    def __init__(self, folder: Path, kind: str, type_hash: str) -> None:
        """Write to a new folder messages of the ROS type `kind`, which is to be that of `DEFINITION`."""
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
        """Write a message with its encapsulation header."""
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
