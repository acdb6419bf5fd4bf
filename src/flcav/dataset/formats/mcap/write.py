"""Writer of MCAP files, one for each scene, with time stamps of the simulation."""

import json
from collections import Counter
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from google.protobuf.message import Message
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from flcav.config import Json
from flcav.dataset.formats.exporter import Exported, ExportFormat, ExportOptions, read_frame
from flcav.dataset.formats.mcap.messages import JsonMessage, make_messages
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report


def export_mcap(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write `<scene>.mcap` for each scene of `dataset`: see `ExportFormat`."""
    counts: Counter[str] = Counter(files=0, messages=0, objects=0)
    done = 0
    for scene in dict.fromkeys(key.scene for key in dataset.keys):
        with (out / f"{scene}.mcap").open("wb") as file:
            log = _Log(Writer(file))
            for i in dataset.select(scenes=[scene]):
                frame = read_frame(dataset, i, options)
                for logged in make_messages(frame):
                    log.write(f"/{frame.agent}/{logged.topic}", logged.message, logged.time_s)
                    counts["messages"] += 1
                counts["objects"] += len(frame.annotations)
                done += 1
                progress(done, len(dataset), "")
            log.writer.finish()
        counts["files"] += 1
    return Exported(counts)


EXPORT = ExportFormat(export_mcap, ("calibration",))


class _Log:
    """An open MCAP file with a channel for each topic, registered by its first message."""

    def __init__(self, writer: Writer) -> None:
        writer.start(profile="", library="flcav")
        self.writer = writer
        self._channels: dict[str, int] = {}
        self._schema = cache(lambda kind: register_schema(writer, kind))
        self._json_schema = cache(lambda kind, schema: writer.register_schema(kind, "jsonschema", schema))

    def write(self, topic: str, message: Message | JsonMessage, time_s: float) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._open(topic, message)
        if isinstance(message, JsonMessage):
            data = json.dumps(message.values, allow_nan=False).encode()
        else:
            data = message.SerializeToString(deterministic=True)
        stamp = round(time_s * 1e9)
        self.writer.add_message(self._channels[topic], log_time=stamp, publish_time=stamp, data=data)

    def _open(self, topic: str, message: Message | JsonMessage) -> int:
        if isinstance(message, JsonMessage):
            schema = json.dumps(_schema_of(message.values)).encode()
            return self.writer.register_channel(topic, "json", self._json_schema(f"flcav.{message.kind}", schema))
        return self.writer.register_channel(topic, "protobuf", self._schema(type(message)))


def _schema_of(value: Json) -> dict[str, Json]:
    """Return the JSON schema of a value made of objects, texts and numbers."""
    if isinstance(value, Mapping):
        return {"type": "object", "properties": {name: _schema_of(part) for name, part in value.items()}}
    return {"type": "string" if isinstance(value, str) else "number"}
