"""Send calls that no client sends to `flcav carla serve`: python tools/fuzz_carla.py --port 2000 --messages 100000.

Known calls with arguments of their types, with arguments of any type and with mutated bytes, and noise. It stops with
exit code 1 where the server is down, does not answer `version`, or takes more than `--memory` MB.
"""

import argparse
import random
import socket
import sys
import time
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from flcav.carla.server import wire
from flcav.carla.server.blueprints import list_blueprints
from flcav.carla.server.calls import Calls

SKIPPED = {"load_new_episode", "copy_opendrive_to_file"}  # they take seconds where they work: a few are enough
FEW = 0.001  # share of them


def list_methods() -> list[str]:
    """Return the names of all calls."""
    methods = [name for name in dir(Calls) if not name.startswith("_") and callable(getattr(Calls, name))]
    return [name for name in methods if "return" in get_type_hints(getattr(Calls, name))]


def draw_value(rng: random.Random, depth: int = 0) -> Any:
    """Return a random value of MessagePack."""
    kind = rng.randrange(9 if depth < 4 else 7)
    match kind:
        case 0:
            return rng.choice((None, True, False))
        case 1:
            return rng.choice((0, 1, 2, 3, -1, 2**31, 2**63, 255, 40, 41, 42))
        case 2:
            return rng.choice((0.0, 1.0, -1.0, 1e9, 1e300, float("nan"), float("inf"), rng.uniform(-200, 200)))
        case 3:
            return rng.choice(("", "vehicle.tesla.model3", "sensor.camera.rgb", "grid", "../x", "a" * 300))
        case 4:
            return rng.randbytes(rng.randrange(30))
        case 5:
            return [rng.uniform(-100, 100) for _ in range(3)]
        case 6:
            return [[rng.uniform(-100, 100) for _ in range(3)], [rng.uniform(-180, 180) for _ in range(3)]]
        case 7:
            known = rng.choice(list(list_blueprints().values())).definition
            return [known.uid, known.id, [[each.id, each.type, each.value] for each in known.attributes]]
    return [draw_value(rng, depth + 1) for _ in range(rng.randrange(6))]


def draw_typed(rng: random.Random, kind: Any) -> Any:
    """Return a random value of a type on the wire."""
    if kind is float:
        return rng.choice((0.0, 1.0, rng.uniform(-200, 200), rng.uniform(-1e8, 1e8)))
    if kind is int:
        return rng.choice((0, 1, 2, 3, rng.randrange(100), rng.randrange(-(2**63), 2**64)))
    if kind is bool:
        return rng.random() < 0.5
    if kind is str:
        return rng.choice(("", "grid", "x" * 100))
    if kind is wire.Description:
        known = rng.choice(list(list_blueprints().values())).definition
        return [known.uid, known.id, [[each.id, each.type, each.value] for each in known.attributes]]
    if isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return [draw_typed(rng, hint) for hint in get_type_hints(kind).values()]
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        return [
            draw_typed(rng, part) for part in (parts if parts[-1] is not Ellipsis else parts[:1] * rng.randrange(4))
        ]
    if get_args(kind):
        return [False] if rng.random() < 0.5 else [True, draw_typed(rng, get_args(kind)[0])]
    return draw_value(rng)


def draw_arguments(rng: random.Random, method: str) -> list[Any]:
    """Return random arguments of a call, of its types or of any."""
    if method == "apply_batch":
        inner = [name for name in wire.COMMANDS if hasattr(Calls, name)]
        commands = [(wire.COMMANDS.index(name), draw_arguments(rng, name)) for name in rng.choices(inner, k=3)]
        spawn = [
            draw_typed(rng, kind) for kind in (wire.Description, wire.Transform, int | None, int, str, tuple[int, ...])
        ]
        return [[[[number, fields]] for number, fields in [*commands, (0, spawn), (rng.randrange(-1, 24), [])]], False]
    if rng.random() < 0.2:
        return [draw_value(rng) for _ in range(rng.randrange(5))]
    kinds = get_type_hints(getattr(Calls, method))
    return [draw_typed(rng, kind) for name, kind in kinds.items() if name != "return"]


def draw_message(rng: random.Random, methods: list[str]) -> bytes:
    """Return the bytes of one message."""
    method = rng.choice(methods)
    if method in SKIPPED and rng.random() > FEW:
        method = "apply_batch"
    return wire.pack_value([0, rng.randrange(2**32), method, [[False], *draw_arguments(rng, method)]])


def draw_noise(rng: random.Random, message: bytes) -> bytes:
    """Return a message with mutated bytes, or others."""
    if rng.random() < 0.3:
        return rng.randbytes(rng.randrange(1, 200))
    mutated = bytearray(message)
    for _ in range(rng.randrange(1, 4)):
        mutated[rng.randrange(len(mutated))] = rng.randrange(256)
    return bytes(mutated)


def ask_version(port: int) -> bool:
    """Return whether the server answers."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=60) as link:
            link.sendall(wire.pack_value([0, 1, "version", [[False]]]))
            return wire.VERSION.encode() in link.recv(1000)
    except OSError:
        return False


def main() -> None:
    """Send the messages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, default=2000)
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pid", type=int, help="the server's process, whose memory is looked at")
    parser.add_argument("--memory", type=float, default=2000.0, help="MB")
    options = parser.parse_args()
    if not ask_version(options.port):
        parser.error(
            f"nobody answers at port {options.port}; start `flcav carla serve grid --port {options.port}` before"
        )
    rng, methods, begun = random.Random(options.seed), list_methods(), time.monotonic()
    sent = closed = told = 0
    while sent < options.messages:
        batch = [draw_message(rng, methods) for _ in range(50)]
        if rng.random() < 0.5:  # the connection may be closed at the first of these
            batch[rng.randrange(50) :] = [draw_noise(rng, message) for message in batch[-10:]]
        try:
            with socket.create_connection(("127.0.0.1", options.port), timeout=120) as link:
                link.sendall(b"".join(batch))
                link.shutdown(socket.SHUT_WR)
                while link.recv(1 << 16):
                    pass
        except ConnectionError:
            closed += 1
        sent += len(batch)
        if sent >= told + 5000:
            told = sent
            memory = 0.0
            if options.pid:
                status = Path(f"/proc/{options.pid}/status").read_text()
                memory = int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024
            print(f"{sent} messages, {memory:.0f} MB, {time.monotonic() - begun:.0f} s", flush=True)
            if not ask_version(options.port) or memory > options.memory:
                sys.exit("the server is down, or takes too much memory")
    print(f"the server is up after {sent} messages; {closed} connections were reset")


if __name__ == "__main__":
    main()
