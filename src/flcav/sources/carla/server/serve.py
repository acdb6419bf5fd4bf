"""The server: remote procedure calls at one port, streams at the next, one loop.

In synchronous mode a tick follows a cue; otherwise ticks follow the clock. A tick sends what sensors measure, in order,
then the world's state and the answer to its cue, upon which a client goes on, and then the cameras' images, which take
longest: they are drawn beside the next ticks, and the next images wait for them. A reader who does not keep up is
waited for, and dropped after `STUCK_S`.
"""

import asyncio
import logging
import signal
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from flcav.config import InputError
from flcav.sources.carla.server import wire
from flcav.sources.carla.server.blueprints import Refused
from flcav.sources.carla.server.calls import Calls, invoke
from flcav.sources.carla.server.episode import Episode, Measurement

STUCK_S = 10.0
# A client's Traffic Manager misses its wake-up, and waits for ever, where the next tick comes before its thread sleeps
# (`TrafficManagerLocal::SynchronousTick` notifies without the lock): so ticks are not closer than this while one runs.
PACE_S = 0.008
LEARNT_S = 3.0  # clients have learnt of a new map by then
LISTENER_S = 0.3  # a tick waits so long for the connection of a stream whose token a client has just asked for
MOST_CONNECTIONS = 512
MOST_CUES = 1000  # whose answers wait for their ticks; clients have one each
CUES = ("tick_cue",)  # calls that are answered after the next tick in synchronous mode
# In asynchronous mode, so that a client has a state with the new actor when it learns of it, as with CARLA, which
# answers few calls a frame: a walker's AI that a client starts ends where its walker is in no state.
SPAWNS = ("spawn_actor", "spawn_actor_with_parent")
CHUNK = 1 << 16
BACKLOG = 1 << 20  # bytes in a connection's buffer from which its reader is waited for

log = logging.getLogger("flcav.carla")


class Server:
    """Serves the clients of one `Calls`."""

    def __init__(self, calls: Calls) -> None:
        """Take the calls to be served."""
        self._calls = calls
        self._streams: dict[int, set[asyncio.StreamWriter]] = {}
        self._connections: set[asyncio.StreamWriter] = set()
        self._cue = asyncio.Event()
        self._refused: set[str] = set()  # told in the log once
        self._worlds: set[int] = set()  # streams of the world's state, of earlier episodes too
        self._published_s = 0.0  # when the world's state was last sent
        self._state = b""  # the last one of the world, for clients that come between two ticks
        # A client that has the answer to its cue waits for the state by polling, which takes a core from the sensors.
        self._cued: deque[tuple[asyncio.StreamWriter, bytes]] = deque()  # answers that wait for the next ticks
        self._drawing: asyncio.Task[None] | None = None  # the images of an earlier tick

    async def run(self, doors: tuple[socket.socket, socket.socket], ready: Callable[[], None]) -> None:
        """Serve until cancelled, calls at the first of two bound sockets and streams at the second."""
        connected = self._serve_calls, self._serve_stream
        servers = [await asyncio.start_server(serve, sock=door) for serve, door in zip(connected, doors, strict=True)]
        ready()
        try:
            await self._tick_forever()
        finally:
            for server in servers:
                server.close()
            for writer in self._connections:
                writer.transport.abort()
            while self._connections:  # each is forgotten when its reader has come to the end
                await asyncio.sleep(0.001)
            if self._drawing is not None:
                await self._drawing
            self._calls.episode.close()

    # ---- ticks

    async def _tick_forever(self) -> None:
        due = time.monotonic()
        while True:
            self._answer_cues()  # and spawnings since the last tick of asynchronous mode
            if self._calls.settings.synchronous:
                await self._cue.wait()
                self._cue.clear()
                while self._calls.ticks and self._calls.settings.synchronous:
                    self._calls.ticks -= 1
                    await self._tick()
                self._answer_cues()
                due = time.monotonic()
                continue
            self._calls.ticks = 0
            due = max(due + self._calls.dt_s, time.monotonic())
            await self._sleep_until(due)
            if not self._calls.settings.synchronous:
                await self._tick()

    async def _sleep_until(self, due: float) -> None:
        """Wait for a time, or for the change to synchronous mode."""
        self._cue.clear()
        with suppress(TimeoutError):
            await asyncio.wait_for(self._cue.wait(), max(due - time.monotonic(), 0.0))

    async def _tick(self) -> None:
        await self._await_listeners()
        try:
            await self._step()
        except Exception:  # a server that fails one tick serves the next
            log.exception("a tick failed")

    async def _step(self) -> None:
        episode, dt_s = self._calls.episode, self._calls.dt_s
        episode.step(dt_s)
        self._state = episode.describe_world(dt_s)
        measurements = list(episode.measure(dt_s, self._is_heard))
        for each in measurements:
            if not each.late:
                await self._measure(each, episode)
        if episode is not self._calls.episode:  # another map was loaded meanwhile
            return
        if self._calls.managed:
            await asyncio.sleep(self._published_s + PACE_S - time.monotonic())
        self._publish_state(episode)
        self._published_s = time.monotonic()
        self._answer_cues(1)
        if images := [each for each in measurements if each.late]:
            if self._drawing is not None:
                await self._drawing
            self._drawing = asyncio.create_task(self._draw(images, episode))
        await self._await_readers(self._connections)

    async def _draw(self, images: list[Measurement], episode: Episode) -> None:
        try:
            for each in images:
                await self._measure(each, episode)
        except Exception:  # a server that fails one image draws the next
            log.exception("an image failed")

    def _answer_cues(self, most: int | None = None) -> None:
        """Answer what waits for the ticks that were made; all that waits, where none is to come."""
        for _ in range(len(self._cued) if most is None else min(most, len(self._cued))):
            writer, reply = self._cued.popleft()
            with suppress(ConnectionError, RuntimeError):
                writer.write(reply)

    async def _measure(self, each: Measurement, episode: Episode) -> None:
        """Send what a sensor measures, beside this thread where it casts rays, so that calls are answered meanwhile."""
        body = each.body
        if not isinstance(body, bytes):
            body = await asyncio.to_thread(body) if each.rays else body()
        if episode is self._calls.episode:
            self._publish(each.stream, each.header + body)
            await self._await_readers(self._streams.get(each.stream, set()))

    def _publish_state(self, episode: Episode) -> None:
        """Send the world's state; after a map was loaded, at first only to those who have learnt of it.

        A client that loads a map closes the stream of the one before, and crashes if something arrives meanwhile.
        """
        self._worlds = {stream for stream in self._worlds if stream in self._streams}
        for stream in self._worlds:
            if stream == episode.stream or episode.age_s > LEARNT_S:
                self._publish(stream, self._state)

    def _is_heard(self, stream: int) -> bool:
        return bool(self._streams.get(stream))

    async def _await_listeners(self) -> None:
        """Wait for the streams that clients are about to listen to, so that these miss no tick."""
        expected, until = self._calls.expected, time.monotonic() + LISTENER_S
        while expected and time.monotonic() < until:
            await asyncio.sleep(0.001)
        expected.clear()

    async def _await_readers(self, writers: set[asyncio.StreamWriter]) -> None:
        for writer in list(writers):
            if writer.transport.get_write_buffer_size() <= BACKLOG:
                continue
            try:
                await asyncio.wait_for(writer.drain(), STUCK_S)
            except (TimeoutError, ConnectionError):
                log.warning("a client reads no more: its connection is closed")
                writer.transport.abort()
                self._forget(writer)

    def _publish(self, stream: int, payload: bytes) -> None:
        for writer in list(self._streams.get(stream, ())):
            self._send(writer, payload)

    @staticmethod
    def _send(writer: asyncio.StreamWriter, payload: bytes) -> None:
        with suppress(ConnectionError, RuntimeError):
            writer.write(struct.pack("<I", len(payload)) + payload)

    # ---- connections

    def _admit(self, writer: asyncio.StreamWriter) -> bool:
        if len(self._connections) >= MOST_CONNECTIONS:
            log.warning("more than %d connections: one is refused", MOST_CONNECTIONS)
            writer.close()
            return False
        self._connections.add(writer)
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # asyncio may not
        return True

    def _forget(self, writer: asyncio.StreamWriter) -> None:
        self._connections.discard(writer)
        for stream in [stream for stream, writers in self._streams.items() if writer in writers]:
            self._streams[stream].discard(writer)
            if not self._streams[stream]:
                del self._streams[stream]
        writer.close()

    async def _serve_calls(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self._admit(writer):
            return
        unpacker = wire.Unpacker()
        try:
            while data := await reader.read(CHUNK):
                unpacker.feed(data)
                for message in unpacker:
                    call = wire.read_call(message)
                    response = self._answer(call)
                    if call.number is None:
                        continue
                    reply = wire.pack_reply(call.number, response)
                    waits = call.method in (CUES if self._calls.settings.synchronous else SPAWNS)
                    if waits and len(self._cued) < MOST_CUES:
                        self._cued.append((writer, reply))
                    else:
                        writer.write(reply)
                await self._await_readers({writer})
        except ConnectionError:
            pass
        except (ValueError, TypeError, RecursionError, OverflowError, KeyError) as error:
            what = str(error) or type(error).__name__
            log.warning("a connection is closed: %s; clients of CARLA %s are served here", what[:200], wire.VERSION)
        finally:
            self._forget(writer)

    def _answer(self, call: wire.Call) -> wire.Packed:
        """Return the response to a call."""
        log.debug("%s %.200s", call.method, call.arguments)
        try:
            value = invoke(self._calls, call.method, call.arguments)
        except (Refused, InputError, wire.WireError) as error:
            self._tell(call.method, str(error))
            return [] if call.method == "apply_batch" else wire.fail(str(error))
        except Exception as error:  # a server that fails one call serves the others
            log.exception("the call %s failed", call.method[:60])
            return wire.fail(f"{call.method[:60]} failed on the server: {type(error).__name__}")
        if call.method == "load_new_episode":
            self._state = self._calls.episode.describe_world(0.0)
        if self._calls.ticks or call.method in ("set_episode_settings", "load_new_episode"):
            self._cue.set()
        if call.method == "apply_batch":
            return value
        return wire.DONE if value is None else wire.succeed(value)

    def _tell(self, method: str, message: str) -> None:
        if method not in self._refused and len(self._refused) < 1000:
            self._refused.add(method)
            log.warning("refused: %s", message[:300])

    async def _serve_stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self._admit(writer):
            return
        try:
            (stream,) = struct.unpack("<I", await reader.readexactly(4))
            self._streams.setdefault(stream, set()).add(writer)
            self._calls.expected.discard(stream)
            if stream == self._calls.episode.stream:
                self._worlds.add(stream)
                self._send(writer, self._state or self._calls.episode.describe_world(0.0))
            while await reader.read(1024):
                pass
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            self._forget(writer)


def open_doors(host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """Return sockets at `port` and the next one; raises `InputError` where one is in use."""
    doors = []
    for number in (port, port + 1):
        try:
            doors.append(socket.create_server((host, number)))
        except OSError as error:
            for door in doors:
                door.close()
            why = (error.strerror or str(error)).partition(" (")[0].lower()
            raise InputError(f"port {number} of {host}: {why}; a server takes --port and the next one") from None
    return doors[0], doors[1]


def serve(calls: Calls, doors: tuple[socket.socket, socket.socket], ready: Callable[[], None]) -> None:
    """Serve clients until interrupted or terminated (SIGTERM), at the sockets of `open_doors`."""

    async def run() -> None:
        task = asyncio.current_task()
        assert task is not None
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
        await Server(calls).run(doors, ready)

    with suppress(asyncio.CancelledError):
        asyncio.run(run())
