"""The server: remote procedure calls at one port, streams at the next, in one event loop.

In synchronous mode a tick follows a client's cue; otherwise ticks follow the clock. A tick sends the measurements of
the sensors in order, then the world state, then the cameras' images, which take longest, and finally the reply to its
cue, upon which the client continues. The reply waits for the images at most `DELIVERY_S`; they are then rendered
concurrently with the next ticks, as in asynchronous mode, and the next images wait for them. Cameras are prepared
concurrently, too.

The resources of a client are bounded: a connection with many cues that wait for their ticks is not read further; the
other bounds are in `Connections`.
"""

import asyncio
import logging
import os
import signal
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from flcav.carla.server import wire
from flcav.carla.server.blueprints import CallRefused
from flcav.carla.server.calls import Calls, invoke
from flcav.carla.server.connections import Connections, Unpacker, send_payload, write
from flcav.carla.server.episode import Episode
from flcav.carla.server.streams import Measurement
from flcav.config import InputError

# A client's Traffic Manager misses its wake-up, and deadlocks, if the next tick comes before its thread sleeps
# (`TrafficManagerLocal::SynchronousTick` notifies without the lock): so ticks are at least this far apart while one
# runs.
PACE_S = 0.008
MOST_UNDRAWN = 100  # cued ticks whose images may wait for the cameras' preparation, longer than clients' timeouts
DELIVERY_S = 1.5  # clients' timeouts of a tick are at least 2 s
PREPARING_S = 3.0  # a server waits so long for its cameras; the first one on a machine compiles for longer
LEARNT_S = 3.0  # time within which clients have learnt of a new map
# While a client that has loaded a map learns of it by these calls, its Traffic Manager's thread would crash if it
# continued: so that thread's calls, which are all others, are answered once the client subscribes to the new world.
LEARNING = ("version", "get_episode_info", "get_sensor_token")
MANAGER_S = 1.0  # the reply to a client that has loaded a map waits for that thread's next call, at most so long
LISTENER_S = 0.3  # a tick waits so long for the subscription to a stream whose token a client has just requested
MOST_CUES, MOST_CUES_IN_ALL = 8, 256  # waiting cues of a connection, and of all; a regular client has one
UNFINISHED_S = 30.0  # time limit for the rest of an incomplete call, and for a stream's id
ENDING_S = 3.0  # a terminated server ends within this time, whatever it is doing
# In asynchronous mode their replies wait for the next tick, so that a client has a world state with the new actor when
# it learns of it, as with CARLA: the AI of a walker that is in no state yet would stop.
SPAWNS = ("spawn_actor", "spawn_actor_with_parent")
CHUNK = 1 << 16

log = logging.getLogger("flcav.carla")


class CarlaServer:
    """A server of remote procedure calls and streams for clients of CARLA."""

    def __init__(self, calls: Calls) -> None:
        """Set the handlers of calls."""
        self._calls = calls
        self._links = Connections()
        self._cue, self._room = asyncio.Event(), asyncio.Event()
        self._worlds: set[int] = set()  # streams of world states, also of earlier episodes
        self._published_s = 0.0  # time at which the world state was last sent
        self._state = b""  # the last world state, for clients that subscribe between two ticks
        # A client with the reply to its cue waits for the state by polling, which takes a core from the sensors: so
        # replies are sent after the state.
        self._cued: deque[tuple[asyncio.StreamWriter, bytes]] = deque()  # replies that wait for the next ticks
        self._preparing: asyncio.Task[None] | None = None  # preparation of a newly loaded map
        self._loaded: dict[asyncio.StreamWriter, bytes] = {}  # pending replies to clients that have loaded a map
        self._held: dict[asyncio.StreamWriter, list[bytes]] = {}  # pending replies to their Traffic Managers
        self._drawing: asyncio.Task[None] | None = None  # rendering of the last images, which awaits earlier ones
        self._undrawn = 0  # ticks whose images are not rendered yet

    async def run(self, doors: tuple[socket.socket, socket.socket], ready: Callable[[], None]) -> None:
        """Serve until cancelled: calls at the first of two bound sockets, streams at the second."""
        connected = self._serve_calls, self._serve_stream
        servers = [
            await asyncio.start_server(callback, sock=door) for callback, door in zip(connected, doors, strict=True)
        ]
        await asyncio.wait({self._prepare()}, timeout=PREPARING_S)
        ready()
        try:
            await self._tick_forever()
        finally:
            for server in servers:
                server.close()
            self._room.set()
            await self._links.close()
            if self._drawing is not None:
                self._drawing.cancel()
            self._calls.episode.close()

    def _prepare(self) -> asyncio.Task[None]:
        """Prepare the sensors of the episode concurrently."""
        self._preparing = asyncio.create_task(self._prepare_episode(self._calls.episode))
        return self._preparing

    async def _prepare_episode(self, episode: Episode) -> None:
        try:
            await asyncio.to_thread(episode.prepare)
        except Exception:  # what fails here fails again, with a report, when a sensor needs it
            log.debug("preparing failed", exc_info=True)

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
        await asyncio.sleep(0)  # lets calls and cancellation run between two ticks
        try:
            await self._step()
        except Exception:  # a server that fails one tick serves the next
            log.exception("a tick failed")

    async def _step(self) -> None:
        episode, dt_s, begun_s = self._calls.episode, self._calls.dt_s, time.monotonic()
        episode.step(dt_s)
        self._state = episode.describe_world(dt_s)
        measurements = list(episode.measure(dt_s, self._links.is_heard))
        for measurement in measurements:
            if not measurement.late:
                await self._measure(measurement, episode)
        if episode is not self._calls.episode:  # another map was loaded meanwhile
            return
        if self._calls.managed:
            await asyncio.sleep(self._published_s + PACE_S - time.monotonic())
        await self._publish_state(episode)
        self._published_s = time.monotonic()
        if images := [measurement for measurement in measurements if measurement.late]:
            synchronous = self._calls.settings.synchronous
            unprepared = synchronous and self._preparing is not None and not self._preparing.done()
            if self._drawing is not None and not (unprepared and self._undrawn < MOST_UNDRAWN):
                await self._drawing
            self._undrawn += 1
            self._drawing = asyncio.create_task(self._draw(images, episode, self._drawing))
            if synchronous:
                await asyncio.wait({self._drawing}, timeout=max(begun_s + DELIVERY_S - time.monotonic(), 0.0))
        self._answer_cues(1)
        await self._links.await_readers()

    async def _draw(self, images: list[Measurement], episode: Episode, before: asyncio.Task[None] | None) -> None:
        """Render and send the images of a tick, after those of the tick before."""
        try:
            if before is not None:
                await before
            for measurement in images:
                if episode is self._calls.episode:
                    await self._measure(measurement, episode)
            await self._links.await_readers()
        except Exception:  # a server that fails one image draws the next
            log.exception("an image failed")
        finally:
            self._undrawn -= 1

    def _answer_cues(self, most: int | None = None) -> None:
        """Send the first `most` replies that wait for ticks, or all."""
        for _ in range(len(self._cued) if most is None else min(most, len(self._cued))):
            writer, reply = self._cued.popleft()
            write(writer, reply)
        self._room.set()

    async def _measure(self, measurement: Measurement, episode: Episode) -> None:
        """Measure and send, in another thread if rays are cast, so that calls are answered meanwhile."""
        body = measurement.body
        if not isinstance(body, bytes):
            body = await asyncio.to_thread(body) if measurement.rays else body()
        if episode is self._calls.episode:
            await self._links.publish(measurement.stream, measurement.header + body)

    async def _publish_state(self, episode: Episode) -> None:
        """Send the world state; after a map is loaded, at first only to clients that have subscribed to the new world.

        A client that loads a map closes the stream of the old world, and crashes if a message arrives meanwhile.
        """
        self._worlds = {stream for stream in self._worlds if self._links.is_heard(stream)}
        for stream in self._worlds:
            if stream == episode.stream or episode.age_s > LEARNT_S:
                await self._links.publish(stream, self._state)

    async def _await_listeners(self) -> None:
        """Wait for clients that are about to subscribe to streams, so that they miss no tick."""
        expected = self._calls.expected
        until = time.monotonic() + LISTENER_S
        while expected and time.monotonic() < until:
            await asyncio.sleep(0.001)
        expected.clear()

    # ---- connections

    async def _serve_calls(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self._links.admit(writer):
            return
        unpacker, until = Unpacker(), None
        try:
            while data := await _read(reader, until):
                unpacker.feed(data)
                for message in unpacker:
                    await self._serve_call(wire.read_call(message), writer)
                    until = None
                    self._links.note_active(writer)
                self._links.note_unfinished(writer, unpacker.waiting)
                if not unpacker.waiting:
                    until = None
                elif until is None:
                    until = time.monotonic() + UNFINISHED_S
        except ConnectionError:
            pass
        except TimeoutError:
            self._links.tell("slow", f"a call of which {UNFINISHED_S:g} s bring no end")
        except (ValueError, TypeError, RecursionError, OverflowError, KeyError) as error:
            what = str(error) or type(error).__name__
            log.warning("a connection is closed: %s; clients of CARLA %s are served here", what[:200], wire.VERSION)
        finally:
            self._links.forget(writer)

    async def _serve_call(self, call: wire.Call, writer: asyncio.StreamWriter) -> None:
        """Answer a call, immediately or after the tick that it cues."""
        while not writer.is_closing() and self._is_full(writer):
            self._room.clear()
            await self._room.wait()
        if writer.is_closing():
            raise ConnectionResetError
        self._tell_loaded(writer)
        asked = self._calls.ticks
        response = self._answer(call)
        reply = b"" if call.number is None else wire.pack_reply(call.number, response)
        cues = self._calls.ticks - asked if self._calls.settings.synchronous else call.method in SPAWNS
        waits = cues > 0 and call.method != "apply_batch"
        self._cued.extend([(writer, reply if waits else b"")] * cues)
        if call.method == "load_new_episode" and self._calls.managed:
            self._loaded[writer], self._held[writer] = reply, (held := [])
            asyncio.get_running_loop().call_later(MANAGER_S, self._tell_loaded, writer, reply)
            asyncio.get_running_loop().call_later(MANAGER_S + LEARNT_S, self._release, writer, held)
        elif writer in self._held and call.method not in LEARNING:
            self._held[writer].append(reply)
        elif not waits:
            writer.write(reply)
        await self._links.await_readers([writer])
        await asyncio.sleep(0)  # lets other connections run

    def _is_full(self, writer: asyncio.StreamWriter) -> bool:
        """Return whether a connection's next call has to wait until cues are served."""
        waiting = sum(cue_writer is writer for cue_writer, _ in self._cued)
        return waiting >= MOST_CUES or len(self._cued) >= MOST_CUES_IN_ALL

    def _tell_loaded(self, writer: asyncio.StreamWriter, reply: bytes | None = None) -> None:
        """Send the pending reply to a client that has loaded a map; with `reply`, only if it is this one."""
        if writer in self._loaded and reply in (None, self._loaded[writer]):
            write(writer, self._loaded.pop(writer))

    def _release(self, writer: asyncio.StreamWriter, held: list[bytes] | None = None) -> None:
        """Send the held replies of a client that has learnt of a new map; with `held`, only if they are these."""
        if writer in self._held and (held is None or held is self._held[writer]):
            for reply in self._held.pop(writer):
                write(writer, reply)

    def _answer(self, call: wire.Call) -> wire.Packed:
        """Execute a call and return the response."""
        log.debug("%s %.200s", call.method, call.arguments)
        try:
            value = invoke(self._calls, call.method, call.arguments)
        except (CallRefused, InputError, wire.WireError) as error:
            self._links.tell(call.method, str(error))
            return [] if call.method == "apply_batch" else wire.fail(str(error))
        except Exception as error:  # a server that fails one call serves the others
            log.exception("the call %s failed", call.method[:60])
            return wire.fail(f"{call.method[:60]} failed on the server: {type(error).__name__}")
        if call.method == "load_new_episode":
            self._state = self._calls.episode.describe_world(0.0)
            self._prepare()
        if self._calls.ticks or call.method in ("set_episode_settings", "load_new_episode"):
            self._cue.set()
        if call.method == "apply_batch":
            return value
        return wire.DONE if value is None else wire.succeed(value)

    async def _serve_stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self._links.admit(writer):
            return
        try:
            async with asyncio.timeout(UNFINISHED_S):
                (stream,) = struct.unpack("<I", await reader.readexactly(4))
            self._links.listen(writer, stream)
            self._calls.expected.discard(stream)
            if stream == self._calls.episode.stream:
                self._worlds.add(stream)
                for loader in list(self._held):
                    self._release(loader)
                send_payload(writer, self._state or self._calls.episode.describe_world(0.0))
            while await reader.read(1024):
                pass
        except (asyncio.IncompleteReadError, ConnectionError, TimeoutError):
            pass
        finally:
            self._links.forget(writer)


async def _read(reader: asyncio.StreamReader, until: float | None) -> bytes:
    """Return the next bytes. Raises `TimeoutError` if none arrive until `until`, a time of the loop's clock [s]."""
    async with asyncio.timeout_at(until):
        return await reader.read(CHUNK)


def open_doors(host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """Return bound sockets at `port` and the next one. Raises `InputError` where one is in use."""
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


def serve_clients(calls: Calls, doors: tuple[socket.socket, socket.socket], ready: Callable[[], None]) -> None:
    """Serve clients at the sockets of `open_doors` until interrupted or terminated (SIGTERM).

    Raises `KeyboardInterrupt` after Ctrl-C.
    """
    interrupted = False

    def leave() -> None:
        calls.maps.discard_files()
        if interrupted:
            print("flcav: interrupted", file=sys.stderr, flush=True)  # as the command line does
        os._exit(128 + signal.SIGINT if interrupted else 0)

    async def run() -> None:
        task, loop = asyncio.current_task(), asyncio.get_running_loop()
        assert task is not None

        def end(number: int, _: object) -> None:
            nonlocal interrupted
            interrupted = number == signal.SIGINT
            last = threading.Timer(ENDING_S, leave)  # loading a map, or an image, may take longer
            last.daemon = True
            last.start()
            loop.call_soon_threadsafe(task.cancel)

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, end)
        await CarlaServer(calls).run(doors, ready)

    with suppress(asyncio.CancelledError):
        asyncio.run(run())
    if interrupted:
        raise KeyboardInterrupt
