"""CARLA's own smoke tests and examples, and scripts of others, against `flcav carla serve`: `make test-carla`.

They are in the folder that FLCAV_REAL_DATA names, `carla_pythonapi` and `carla_scripts`, with maps in `carla_maps`.
They run unchanged in an environment of their own, out/carla, built once; windows are on a dummy display. A script that
runs for ever is interrupted after a while, and has then printed no traceback but that of the interruption.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate

HERE = Path(__file__).parent
ROOM = HERE.parents[1] / "out" / "carla"
DATA = Path(os.environ.get("FLCAV_REAL_DATA", HERE.parents[1].parent / "shared" / "data"))
API, OTHERS, MAPS = DATA / "carla_pythonapi", DATA / "carla_scripts", DATA / "carla_maps"
PACKAGES = ("carla==0.9.16", "pygame", "numpy==1.23.5", "matplotlib==3.8.4", "pandas<2.1", "plyfile<1.1")
TOOLS = ("networkx", "shapely", "pytest")
ENDLESS_S = 20
# script -> arguments, and how long it runs: None to its own end
SCRIPTS: dict[str, tuple[tuple[str, ...], int | None]] = {
    "tutorial.py": ((), None),
    "start_recording.py": (("-n", "5", "-t", "5"), None),
    "lidar_to_camera.py": (("--frames", "5"), None),
    "synchronous_mode.py": ((), ENDLESS_S),
    "sensor_synchronization.py": ((), ENDLESS_S),
    "dynamic_weather.py": ((), ENDLESS_S),
    "vehicle_gallery.py": ((), ENDLESS_S),
    "generate_traffic.py": (("-n", "20", "-w", "10"), ENDLESS_S),
    "no_rendering_mode.py": ((), ENDLESS_S),
    "client_bounding_boxes.py": ((), ENDLESS_S),
    "automatic_control.py": (("--sync", "--res", "320x240"), ENDLESS_S),
}
INTERRUPTED = ("KeyboardInterrupt", "Cancelled by user", "Exited by user", "destroying", "done.", "Done", "EXIT")
ABORTED = "terminate called without an active exception"  # of the client's threads, as the interpreter ends
pytestmark = pytest.mark.skipif(not API.is_dir(), reason=f"not at {API}: set FLCAV_REAL_DATA")


@pytest.fixture(scope="session")
def python() -> Path:
    """The interpreter of the scripts' environment."""
    path = ROOM / "bin" / "python"
    if not (ROOM / "ready").exists():
        venv.create(ROOM, with_pip=True, clear=True)
        subprocess.run([path, "-m", "pip", "install", "--quiet", *PACKAGES, *TOOLS], check=True)
        (ROOM / "ready").touch()
    return path


def serve(port: int, folder: Path):
    """Yield while a server of Town10HD_Opt is up at a port; Town02 is there as Town03 too, which smoke tests load."""
    maps = folder / "maps"
    maps.mkdir()
    for name, source in {"Town10HD": "Town10HD", "Town02": "Town02", "Town03": "Town02"}.items():
        shutil.copyfile(MAPS / f"{source}.xodr", maps / f"{name}.xodr")
    command = [sys.executable, "-m", "flcav", "carla", "serve", "Town10HD_Opt", "--maps", str(maps)]
    command += ["--port", str(port)]
    with (folder / "log").open("w") as log:
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, cwd=folder)
        assert server.stdout is not None
        assert "ready" in server.stdout.readline(), (folder / "log").read_text()
        yield port
        assert server.poll() is None
        server.terminate()
        server.wait()
    assert "Traceback" not in (folder / "log").read_text()


def is_free(port: int) -> bool:
    with socket.socket() as door:
        return door.connect_ex(("127.0.0.1", port)) != 0


@pytest.fixture(scope="module")
def usual_port(tmp_path_factory):
    if not is_free(2000):
        pytest.skip("port 2000, which the scripts ask, is in use")
    yield from serve(2000, tmp_path_factory.mktemp("scripts"))


@pytest.fixture(scope="module")
def smoke(python, tmp_path_factory):
    """CARLA's smoke tests, which sleep most of the time: they run beside the examples, at a server of their own."""
    if not is_free(3654):
        pytest.skip("port 3654, which the smoke tests ask, is in use")
    command = [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider", "smoke"]
    settings = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    for _ in serve(3654, tmp_path_factory.mktemp("smoke")):
        with subprocess.Popen(command, cwd=API / "test", env=settings, stdout=subprocess.PIPE, text=True) as process:
            yield process
            process.kill()


def run_script(python: Path, script: Path, arguments: tuple[str, ...], for_s: int | None, folder: Path) -> str:
    """Return what a script prints, to its end or until it is interrupted."""
    settings = os.environ | {"SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy", "PYTHONUNBUFFERED": "1"}
    settings |= {"PYTHONPATH": f"{API / 'carla'}{os.pathsep}{HERE / 'stand_ins'}", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [str(python), str(script), *arguments]
    process = subprocess.Popen(
        command, cwd=folder, env=settings, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        told, _ = process.communicate(timeout=for_s or 300)
        aborted = process.returncode == -signal.SIGABRT and told.rstrip().endswith(f"done.\n{ABORTED}")
        assert process.returncode == 0 or aborted, told[-3000:]
    except subprocess.TimeoutExpired:
        assert for_s, "it did not come to its end"
        process.send_signal(signal.SIGINT)
        told, _ = process.communicate(timeout=60)
        assert any(word in told for word in INTERRUPTED), told[-3000:]
    assert "RuntimeError" not in told, told[-3000:]
    return told


@pytest.mark.parametrize("script", SCRIPTS)
def test_examples(script, python, smoke, usual_port, tmp_path):
    run_script(python, API / "examples" / script, *SCRIPTS[script], tmp_path)


@pytest.mark.skipif(not OTHERS.is_dir(), reason=f"not at {OTHERS}: set FLCAV_REAL_DATA")
def test_two_semantic_lidars_at_a_junction(python, usual_port, tmp_path):
    """The script's module `CoordConvertor` is not published with it, and open3d draws nothing: both are stand-ins."""
    told = run_script(python, OTHERS / "generate_multi_lidar_junc1.py", (), ENDLESS_S, tmp_path)
    assert "FPS" in told
    assert list(tmp_path.rglob("*.ply"))


def test_smoke_tests(smoke):
    told, _ = smoke.communicate(timeout=900)
    assert smoke.returncode == 0, told[-5000:]
    assert "14 passed" in told


def test_lights_count_before_the_lanes_that_the_map_says(usual_port):
    """The client finds these lanes by a light's id in the map, which says them of all lights but one."""
    carla = pytest.importorskip("carla")
    client = carla.Client("127.0.0.1", usual_port)
    client.set_timeout(60.0)
    world = client.load_world("Town10HD_Opt")
    lights = world.get_actors().filter("traffic.traffic_light")
    middles = [light.get_transform().transform(light.trigger_volume.location) for light in lights]
    lanes = [light.get_affected_lane_waypoints() for light in lights]
    off = [min(at.distance(lane.transform.location) for lane in own) for at, own in zip(middles, lanes)]
    assert (len(off), sum(away < 8.0 for away in off)) == (16, 15)
    assert len({light.get_opendrive_id() for light in lights}) == 16
    assert {sign.type_id for sign in world.get_actors().filter("traffic.[sy]*")} == {"traffic.stop", "traffic.yield"}


def test_the_recorder_of_the_article_loses_nothing_and_is_read(python, usual_port, tmp_path):
    """Five cars and a post with eleven images and 18 other measurements a tick, each waited for a second at most."""
    raw = tmp_path / "raw_data" / "record_2026_0101_0000"
    told = run_script(python, HERE / "article_recorder.py", (str(raw), str(usual_port), "4"), None, tmp_path)
    assert "done." in told
    ticks = {path.stem for path in (raw / "others.world_0").iterdir()}
    assert len(ticks) == 2
    written = {poses.parent: {path.stem for path in poses.parent.glob("0*")} for poses in raw.glob("*/*/poses.csv")}
    assert len(written) == 5 * 5 + 4
    assert {folder: found for folder, found in written.items() if found != ticks} == {}
    notes = import_dataset("carlaflcav", raw, tmp_path / "out")
    assert [note.partition(",")[0] for note in notes] == ["left out 5 semantic LiDARs", "left out 5 radars"]
    assert validate(tmp_path / "out") == []
    data = Dataset.open(tmp_path / "out")
    frames = [data.frame(row) for row in range(len(data))]
    assert [frame.agent for frame in frames] == ["pole0", "cav0", "cav1", "cav2", "cav3", "cav4"] * 2
    assert all((frame.annotations.returns > 50).any() for frame in frames)
