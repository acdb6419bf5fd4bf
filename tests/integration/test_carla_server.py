"""`flcav carla serve` under the genuine client of CARLA 0.9.16, and under messages that no client sends."""

import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import msgpack
import pytest
from ports import find_port
from waiting import LONGEST_S

from flcav.carla.server import wire
from flcav.cli.main import run

SESSION = Path(__file__).with_name("carla_session.py")
SESSIONS = (
    "the_world",
    "actors",
    "walkers",
    "sensors",
    "events",
    "traffic",
    "loading",
    "loading_beside_a_manager",
)  # the last ones load other maps


@pytest.fixture(scope="module")
def port(tmp_path_factory):
    port = find_port(2)
    command = [sys.executable, "-m", "flcav", "carla", "serve", "suburb", "--port", str(port)]
    log = tmp_path_factory.mktemp("carla") / "log"
    with log.open("w") as errors:
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, cwd=log.parent)
        assert server.stdout is not None
        assert server.stdout.readline() == f"suburb: ready for clients of CARLA 0.9.16 at 127.0.0.1:{port}\n"
        yield port
        assert server.poll() is None, log.read_text()
        server.terminate()
        server.wait()
    assert "Traceback" not in log.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("session", SESSIONS)
def test_the_genuine_client(session, port):
    pytest.importorskip("carla", reason="needs the extra 'carla'")
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    done = subprocess.run(
        [sys.executable, str(SESSION), session, str(port), str(find_port())],
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        env=environment,
    )
    assert done.stdout.endswith("passed\n"), done.stdout + done.stderr


def _ask(port: int, message: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=LONGEST_S) as link:
        link.sendall(message)
        link.shutdown(socket.SHUT_WR)
        answer = b""
        while data := link.recv(1 << 16):
            answer += data
        return answer


def test_messages_that_no_client_sends_leave_the_server_up(port):
    rng = random.Random(0)
    version = wire.pack_value([0, 1, "version", [[False]]])
    for _ in range(200):
        mutated = bytearray(version)
        mutated[rng.randrange(len(mutated))] = rng.randrange(256)
        _ask(port, bytes(mutated) + rng.randbytes(rng.randrange(20)))
        _ask(port + 1, rng.randbytes(rng.randrange(8)))
    assert msgpack.unpackb(_ask(port, version)) == [1, 1, None, [[1, "0.9.16"]]]


def test_a_cue_is_answered_after_the_state_of_its_tick(port):
    """A client that has the answer before polls for the state, with a core that the sensors need."""
    with socket.create_connection(("127.0.0.1", port), timeout=LONGEST_S) as link, socket.socket() as stream:
        unpacker = msgpack.Unpacker()

        def call(method, *arguments):
            link.sendall(wire.pack_value([0, 1, method, [[False], *arguments]]))
            while True:
                unpacker.feed(link.recv(1 << 16))
                for _, _, error, answer in unpacker:
                    assert error is None
                    return answer[0][1]

        try:
            call("set_episode_settings", wire.EpisodeSettings(synchronous=True, fixed_dt_s=0.05).packed())
            _, (token,) = call("get_episode_info")
            stream.connect(("127.0.0.1", port + 1))
            stream.sendall(token[:4])
            stream.recv(1 << 20)  # the state as it is
            for _ in range(3):
                frame = call("tick_cue")
                state = stream.recv(1 << 20, socket.MSG_DONTWAIT)
                assert int.from_bytes(state[12:20], "little") == frame
        finally:
            call("set_episode_settings", wire.EpisodeSettings().packed())


@pytest.mark.parametrize(
    ("how", "code", "told"),
    [(signal.SIGTERM, 0, ""), pytest.param(signal.SIGINT, 130, "flcav: interrupted\n", marks=pytest.mark.slow)],
)
def test_it_ends_without_a_word_about_its_clients_and_leaves_nothing(how, code, told, tmp_path):
    port = find_port(2)
    command = [sys.executable, "-m", "flcav", "carla", "serve", "suburb", "--port", str(port)]
    here = {"cwd": tmp_path, "env": os.environ | {"TMPDIR": str(tmp_path)}}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **here) as server:
        assert server.stdout is not None
        assert "ready" in server.stdout.readline()
        doors = ("127.0.0.1", port), ("127.0.0.1", port + 1)
        with socket.create_connection(doors[0]) as link, socket.create_connection(doors[1]) as stream:
            stream.sendall(b"\x01\x00\x00\x00")
            stream.recv(1)
            link.sendall(
                wire.pack_value(
                    [0, 1, "set_episode_settings", [[False], wire.EpisodeSettings(synchronous=True).packed()]]
                )
            )
            link.sendall(
                wire.pack_value([0, 2, "tick_cue", [[False]]]) * 20_000
            )  # it makes about a thousand ticks a second
            server.send_signal(how)
            begun = time.monotonic()
            _, errors = server.communicate(timeout=LONGEST_S)
            assert time.monotonic() < begun + 10.0
    assert (server.returncode, errors) == (code, told)
    assert list(tmp_path.iterdir()) == []


def test_a_port_in_use_is_one_sentence(port, capsys):
    with pytest.raises(SystemExit) as left:
        run(["carla", "serve", "suburb", "--port", str(port)])
    assert left.value.code == 2
    told = capsys.readouterr().err
    assert f"port {port} of 127.0.0.1: address already in use" in told
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["atlantis"], "no map 'atlantis'; maps here: suburb"),
        (["suburb", "--maps", "nowhere"], "nowhere: is no folder"),
        (["suburb", "--port", "70000"], "70000"),
    ],
)
def test_bad_input_is_one_sentence(arguments, told, capsys):
    with pytest.raises(SystemExit) as left:
        run(["carla", "serve", "--port", str(find_port(2)), *arguments])
    assert left.value.code == 2
    assert told in capsys.readouterr().err
