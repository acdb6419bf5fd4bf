"""Files of each kind that unfold without end, are nested without end, or lead elsewhere.

Each is small, and of a kind that a command reads; whoever reads it has to refuse it before it fills the memory or the
stack.
"""

import io
import json
import struct
import zlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

Rng = np.random.Generator
Bombs = Callable[[bytes], dict[str, bytes]]  # the file's content -> what it is replaced by, by what is done

DEEP = 200_000
LINKS = ("itself", "nowhere", "its folder", "another file")


def bomb(path: Path, rng: Rng) -> str:
    """Replace the file at `path` by a bomb of its kind, or by a link where there is none; return what was done."""
    data = path.read_bytes()
    path.unlink()
    made = BOMBS.get(path.suffix, lambda data: {})(data)
    done = str(rng.choice([*made, *LINKS]))
    if done in made:
        path.write_bytes(made[done])
    else:
        others = sorted(other for other in path.parent.iterdir() if other.is_file()) or [path]
        targets = (path, path.with_name("nowhere"), path.parent, others[int(rng.integers(len(others)))])
        path.symlink_to(targets[LINKS.index(done)])
        done = f"a link to {done}"
    return f"{path.name}: {done}"


def _nest_elements(data: bytes, depth: int) -> bytes:
    """Return an XML document with so many elements in each other at its end."""
    whole, end, root = data.rpartition(b"</")
    return whole + b"<userData>" * depth + b"</userData>" * depth + end + root


def _yaml(data: bytes) -> dict[str, bytes]:
    tenfold = b"".join(b"%c: &%c [%s]\n" % (i, i, b", ".join([b"*%c" % (i - 1)] * 10)) for i in range(98, 108))
    laughs = b"a: &a [x, x, x, x, x, x, x, x, x, x]\n" + tenfold
    first, _, rest = data.partition(b"\n")
    return {
        "nested brackets": b"a: " + b"[" * DEEP + b"]" * DEEP,
        "nested dashes": b"- " * (DEEP // 20) + b"x",
        "aliases of aliases": laughs + data,
        "an alias in the place of a value": laughs + first.partition(b":")[0] + b": *k\n" + rest,
        "an alias within its anchor": b"a: &a [*a]\n" + data,
        "merged aliases": b"a: &a {x: 1}\n" + tenfold.replace(b"[", b"{<<: [").replace(b"]", b"]}") + data,
    }


def _json(data: bytes) -> dict[str, bytes]:
    return {f"{depth} brackets": b"[" * depth + data + b"]" * depth for depth in (90, 110, 900, DEEP)}


def _xml(data: bytes) -> dict[str, bytes]:
    laughs = b"".join(b'<!ENTITY %c "%s">' % (i, b"&%c;" % (i - 1) * 10) for i in range(98, 107))
    head, begin, rest = data.partition(b"?>")
    entities = b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">' + laughs + b"]>"
    whole, end, root = rest.rpartition(b"</")
    return {
        "90 elements in each other": _nest_elements(data, 90),
        "elements in each other": _nest_elements(data, DEEP),
        "entities of entities": head + begin + entities + whole + b"<userData>&j;</userData>" + end + root,
    }


@lru_cache(maxsize=1)
def _run_of_zeros() -> bytes:
    sink, zeros = pa.BufferOutputStream(), pa.table({"x": np.zeros(1 << 20)})
    with pq.ParquetWriter(sink, zeros.schema) as writer:
        for _ in range(200):
            writer.write_table(zeros)
    return sink.getvalue().to_pybytes()


def _pictures(_data: bytes) -> dict[str, bytes]:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(bytes(100))), chunk(b"IEND", b""))
    large = io.BytesIO()
    Image.new("1", (12_000, 9_000)).save(large, "png")
    return {
        "a picture of 3,600 megapixels": b"\x89PNG\r\n\x1a\n" + b"".join(parts),
        "a picture of 108 megapixels": large.getvalue(),
    }


def _depth(_data: bytes) -> dict[str, bytes]:
    zstd, head = pa.Codec("zstd"), io.BytesIO()
    lies = {"descr": "|u1", "fortran_order": False, "shape": (4, 10**6, 10**9)}
    np.lib.format.write_array_header_1_0(head, lies)
    return {
        "zeros without end": zstd.compress(bytes(1 << 28), asbytes=True) * 16,
        "a header that lies": zstd.compress(head.getvalue(), asbytes=True),
    }


def _safetensors(data: bytes) -> dict[str, bytes]:
    size = int.from_bytes(data[:8], "little")
    held = json.loads(data[8 : 8 + size])["__metadata__"]
    tensors = {"__metadata__": held, "w": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}
    text = json.dumps(tensors).encode()
    deep = json.dumps({"__metadata__": dict.fromkeys(held, "[" * DEEP + "]" * DEEP)}).encode()
    return {
        "a header of 2^62 bytes": (2**62).to_bytes(8, "little") + b"{}",
        "a tensor of 2^40 numbers": struct.pack("<Q", len(text)) + text,
        "nested metadata": struct.pack("<Q", len(deep)) + deep,
    }


BOMBS: dict[str, Bombs] = {
    ".yaml": _yaml,
    ".json": _json,
    ".xml": _xml,
    ".xodr": _xml,
    ".parquet": lambda data: {"a run of zeros": _run_of_zeros()},
    ".csv": lambda data: {"a long field": data + b"x" * DEEP, "many fields": data + b"," * DEEP},
    ".png": _pictures,
    ".jpg": _pictures,
    ".webp": _pictures,
    ".zst": _depth,
    ".safetensors": _safetensors,
}
