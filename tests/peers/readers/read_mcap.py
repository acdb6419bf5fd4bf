"""The mcap package on an export: python read_mcap.py EXPORT.

The schemas come from the files alone. It prints of each file and topic the schema, the number of messages, and the
first and last time; every time stamp that a message could have but has not is an error.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

STAMP = "google.protobuf.Timestamp"


def _check(message, path: str) -> None:
    for field in message.DESCRIPTOR.fields:
        kind = field.message_type
        if kind is None:
            continue
        if kind.full_name == STAMP:
            assert message.HasField(field.name), f"{path}.{field.name} is not set"
        else:
            value = getattr(message, field.name)
            for part in value if isinstance(value, (list, tuple)) or hasattr(value, "append") else [value]:
                _check(part, f"{path}.{field.name}")


read = {}
for path in sorted(Path(sys.argv[1]).glob("*.mcap")):
    topics = defaultdict(lambda: {"times": [], "points": 0, "boxes": 0, "rectangles": 0})
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        for schema, channel, message in reader.iter_messages():
            topic = topics[channel.topic]
            topic["schema"] = schema.name
            topic["times"].append(message.log_time)
            if channel.message_encoding == "json":
                topic["fields"] = sorted(json.loads(message.data))
                assert set(topic["fields"]) <= set(json.loads(schema.data)["properties"])
        for _, channel, _, decoded in (
            item
            for item in reader.iter_decoded_messages(topics=[name for name in topics if "fields" not in topics[name]])
        ):
            _check(decoded, channel.topic)
            topic = topics[channel.topic]
            topic["points"] += len(getattr(decoded, "data", b"")) // (getattr(decoded, "point_stride", 0) or 1)
            topic["boxes"] += len(getattr(decoded, "entities", ()))
            topic["rectangles"] += len(getattr(decoded, "points", ()))
        assert summary.statistics.message_count == sum(len(topic["times"]) for topic in topics.values())
    read[path.stem] = topics
print()
print(json.dumps(read))
