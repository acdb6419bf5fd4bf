"""The server among strangers: bursts of calls, readers who never read, and connections that never come to the point."""

import asyncio
import socket
import struct
import threading
import time
from contextlib import asynccontextmanager, suppress

import msgpack
import pytest

from flcav.carla.server import connections, serve, wire
from flcav.carla.server.blueprints import list_blueprints
from flcav.carla.server.calls import Calls
from flcav.carla.server.episode import Episode
from flcav.carla.server.sensors import KINDS, Kind
from flcav.carla.server.serve import CarlaServer
from flcav.carla.server.wire import Stream

SYNCHRONOUS = wire.EpisodeSettings(synchronous=True, fixed_dt_s=0.05).packed()
UNFINISHED = b"\x94\x00\x01\xa7version\xdd\x00\x03\x00\x00"  # the beginning of a call with 196,608 arguments


class Client:
    """One connection for calls."""

    async def connect(self, port):
        self.reader, self.writer = await asyncio.open_connection("127.0.0.1", port)
        self.unpacker, self.number = msgpack.Unpacker(), 0
        return self

    async def call(self, method, *arguments):
        self.number += 1
        self.writer.write(wire.pack_value([0, self.number, method, [[False], *arguments]]))
        while True:
            for _, number, error, answer in self.unpacker:
                assert (number, error) == (self.number, None)
                return answer[0][1]
            data = await self.reader.read(1 << 16)
            if not data:
                raise ConnectionResetError
            self.unpacker.feed(data)


@asynccontextmanager
async def serving(maps):
    """Give the port of a server, and its calls."""
    calls_door, streams_door = (socket.create_server(("127.0.0.1", 0)) for _ in range(2))
    calls = Calls(maps, "suburb", seed=3, traffic=0, port=streams_door.getsockname()[1] - 1)
    task = asyncio.create_task(CarlaServer(calls).run((calls_door, streams_door), lambda: None))
    try:
        yield calls_door.getsockname()[1], streams_door.getsockname()[1], calls
    finally:
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asyncio.wait_for(task, 5.0)


def describe(name):
    return [list_blueprints()[name].definition.uid, name, []]


def test_who_bursts_cues_is_read_no_further_while_others_are_served(maps):
    async def session():
        async with serving(maps) as (port, _, calls):
            other, burst = await Client().connect(port), await Client().connect(port)
            await other.call("set_episode_settings", SYNCHRONOUS)
            burst.writer.write(wire.pack_value([0, 1, "tick_cue", [[False]]]) * 5_000)
            for _ in range(10):
                assert await other.call("version") == wire.VERSION
                assert calls.ticks <= serve.MOST_CUES
            burst.writer.transport.abort()
            for _ in range(5):
                await other.call("tick_cue")
            gone = calls.episode.tick
            await asyncio.sleep(0.1)
            assert calls.episode.tick <= gone + serve.MOST_CUES  # nobody is there for whom the rest would be
            assert calls.episode.tick < 4_000

    asyncio.run(session())


def test_a_server_ends_although_cues_wait(maps, monkeypatch):
    monkeypatch.setattr(CarlaServer, "_tick", lambda self: asyncio.sleep(60.0))

    async def session():
        async with serving(maps) as (port, _, calls):
            client = await Client().connect(port)
            await client.call("set_episode_settings", SYNCHRONOUS)
            client.writer.write(wire.pack_value([0, 2, "tick_cue", [[False]]]) * 100)
            while calls.ticks < serve.MOST_CUES - 1:
                await asyncio.sleep(0.001)
            ending = time.monotonic()
        assert time.monotonic() - ending < 5.0

    asyncio.run(session())


def test_all_who_read_nothing_share_one_deadline(maps, monkeypatch):
    monkeypatch.setattr(connections, "STUCK_S", 0.5)
    monkeypatch.setitem(KINDS, "sensor.other.gnss", Kind(Stream.GNSS, lambda sight, sensor: bytes(8 << 20)))

    async def session():
        async with serving(maps) as (port, streams, calls):
            calls.episode.look("rays")()  # so that no tick takes its time for it
            client = await Client().connect(port)
            await client.call("set_episode_settings", SYNCHRONOUS)
            stuck, here = [], [[0.0, 0.0, 20.0], [0.0, 0.0, 0.0]]
            for _ in range(6):
                token = (await client.call("spawn_actor", describe("sensor.other.gnss"), here))[5]
                link = socket.socket()
                link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                link.connect(("127.0.0.1", streams))
                link.sendall(token[:4])
                stuck.append(link)
            await asyncio.sleep(0.1)
            waits = []
            for _ in range(3):
                begun = time.monotonic()
                await client.call("tick_cue")
                await client.call("version")
                waits.append(time.monotonic() - begun)
            assert await client.call("version") == wire.VERSION
            for link in stuck:
                link.close()
            return waits

    assert 0.4 < max(asyncio.run(session())) < 3 * 0.5  # six times one after another


def test_of_many_unfinished_calls_the_largest_are_dropped(maps, monkeypatch):
    monkeypatch.setattr(connections, "MOST_UNFINISHED", 1_000_000)

    async def session():
        async with serving(maps) as (port, _, _):
            small = await Client().connect(port)
            small.writer.write(wire.pack_value([0, 1, "version", [[False]]])[:5])
            links = [await Client().connect(port) for _ in range(6)]
            for link in links:
                link.writer.write(UNFINISHED + b"\xc0" * 180_000)
                await link.writer.drain()
            ended = 0
            for link in links:
                try:
                    ended += await asyncio.wait_for(link.reader.read(1), 0.2) == b""
                except ConnectionError:
                    ended += 1
                except TimeoutError:
                    pass
            assert ended == 1  # six are more than a million bytes, five are not
            small.writer.write(wire.pack_value([0, 1, "version", [[False]]])[5:])
            assert await small.reader.read(100) == wire.pack_value([1, 1, None, [[1, wire.VERSION]]])

    asyncio.run(session())


def test_a_call_that_comes_to_no_end_ends_its_connection(maps, monkeypatch):
    monkeypatch.setattr(serve, "UNFINISHED_S", 0.2)

    async def session():
        async with serving(maps) as (port, streams, _):
            honest, slow = await Client().connect(port), await Client().connect(port)
            silent = await Client().connect(streams)
            assert await honest.call("version") == wire.VERSION
            for byte in UNFINISHED[:2]:
                slow.writer.write(bytes([byte]))
                await asyncio.sleep(0.1)
            for link in (slow, silent):
                assert await asyncio.wait_for(link.reader.read(1), 5.0) == b""
            assert await honest.call("version") == wire.VERSION  # it has nothing unfinished, and may be idle

    asyncio.run(session())


@pytest.mark.parametrize("idle", [True, False])
def test_a_full_server_closes_who_was_idle_longest(idle, maps, monkeypatch):
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 3)
    monkeypatch.setattr(connections, "IDLE_S", 0.1 if idle else 60.0)

    async def session():
        async with serving(maps) as (port, _, _):
            first, second, third = [await Client().connect(port) for _ in range(3)]
            assert await third.call("version") == wire.VERSION
            await asyncio.sleep(0.2)
            assert await first.call("version") == wire.VERSION
            fourth = await Client().connect(port)
            if not idle:
                with pytest.raises(ConnectionError):
                    await fourth.call("version")
                return
            assert await fourth.call("version") == wire.VERSION
            assert await second.reader.read(1) == b""
            assert await first.call("version") == await third.call("version") == wire.VERSION

    asyncio.run(session())


def test_a_refused_cue_is_answered_at_once(maps):
    async def session():
        async with serving(maps) as (port, _, _):
            client = await Client().connect(port)
            await client.call("set_episode_settings", SYNCHRONOUS)
            assert "0 belong" in (await asyncio.wait_for(client.call("tick_cue", 1, 2), 5.0))[0]

    asyncio.run(session())


def test_replies_that_nobody_reads_are_not_piled_up(maps, monkeypatch):
    monkeypatch.setattr(connections, "STUCK_S", 0.2)

    async def session():
        async with serving(maps) as (port, _, _):
            greedy, other = await Client().connect(port), await Client().connect(port)
            greedy.writer.write(wire.pack_value([0, 1, "get_map_data", [[False]]]) * 2000)  # 150 kB each
            begun = time.monotonic()
            while time.monotonic() < begun + 1.0:
                assert await other.call("version") == wire.VERSION
                await asyncio.sleep(0.05)
            got = 0
            with suppress(ConnectionError):
                while data := await asyncio.wait_for(greedy.reader.read(1 << 20), 5.0):
                    got += len(data)
            assert 100_000 < got < 100_000_000

    asyncio.run(session())


async def listen(client, streams, sensor):
    """Return the reader of what a sensor sends, which a client has spawned."""
    token = (await client.call("spawn_actor", describe(sensor), [[0.0, 0.0, 20.0], [0.0, 0.0, 0.0]]))[5]
    reader, writer = await asyncio.open_connection("127.0.0.1", streams)
    writer.write(token[:4])
    await asyncio.sleep(0.05)
    return reader, writer


async def read_frame(reader):
    """Return the frame of the next payload."""
    (size,) = struct.unpack("<I", await reader.readexactly(4))
    return struct.unpack_from("<Q", await reader.readexactly(size), 8)[0]


@pytest.mark.parametrize("bound_s", [60.0, 0.2])
def test_a_tick_is_answered_when_its_images_are_delivered(bound_s, maps, monkeypatch):
    """But after a while without them: then the next tick waits, so that every image comes, and in order."""
    drawing_s = 0.6
    monkeypatch.setattr(serve, "DELIVERY_S", bound_s)
    camera = Kind(Stream.DEPTH, lambda sight, sensor: time.sleep(drawing_s) or b"image", True, True)
    monkeypatch.setitem(KINDS, "sensor.camera.depth", camera)

    async def session():
        async with serving(maps) as (port, streams, calls):
            calls.episode.prepare()
            client = await Client().connect(port)
            await client.call("set_episode_settings", SYNCHRONOUS)
            reader, writer = await listen(client, streams, "sensor.camera.depth")
            frames, waits = [], []
            for _ in range(3):
                begun = time.monotonic()
                frames.append(await client.call("tick_cue"))
                waits.append(time.monotonic() - begun)
                if bound_s > drawing_s:
                    assert await asyncio.wait_for(read_frame(reader), 0.1) == frames[-1]
            if bound_s < drawing_s:
                assert waits[0] < drawing_s
                assert [await asyncio.wait_for(read_frame(reader), 5.0) for _ in frames] == frames
            assert sum(waits) > 2 * drawing_s - 0.1
            writer.close()

    asyncio.run(session())


def test_ticks_go_on_while_cameras_are_prepared_and_no_image_is_lost(maps, monkeypatch):
    """The first server on a machine compiles for longer than clients give a tick."""
    prepared, frames = threading.Event(), []
    monkeypatch.setattr(serve, "DELIVERY_S", 0.05)
    monkeypatch.setattr(serve, "PREPARING_S", 0.1)
    monkeypatch.setattr(Episode, "prepare", lambda episode: prepared.wait(10.0))
    camera = Kind(Stream.DEPTH, lambda sight, sensor: bytes([prepared.wait(10.0)]), True, True)
    monkeypatch.setitem(KINDS, "sensor.camera.depth", camera)

    async def session():
        async with serving(maps) as (port, streams, _):
            try:
                client = await Client().connect(port)
                await client.call("set_episode_settings", SYNCHRONOUS)
                reader, writer = await listen(client, streams, "sensor.camera.depth")
                for _ in range(5):
                    frames.append(await asyncio.wait_for(client.call("tick_cue"), 2.0))
            finally:
                prepared.set()
            assert [await asyncio.wait_for(read_frame(reader), 5.0) for _ in frames] == frames
            writer.close()

    asyncio.run(session())
