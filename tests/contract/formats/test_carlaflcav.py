"""CarlaFLCAV's raw recordings: folders made as by its recorder are read as they were made; pickles never run."""

import contextlib
import csv
import io
import pickle
import pickletools
import random
import resource
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.formats.carlaflcav_labels import MOST_BYTES, read_labels
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate
from flcav.geometry import inverse, pose, transform_points

WIDTH, HEIGHT, FOCAL = 64, 32, 32.0
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
FIRST, TICKS = 1207, 3
LIDAR, FRONT = pose(0.0, 0.0, 1.7), pose(0.3, 0.0, 1.6, 0.0, np.radians(5.0))
POST = pose(30.0, 12.0, 5.0, np.radians(-90.0), np.radians(20.0))
CORNERS = np.array([(x, y, z) for x in (-0.4, 0.4) for y in (-0.4, 0.4) for z in (-0.4, 0.4)])
SIZES = {"vehicle": (4.6, 1.9, 1.5), "pedestrian": (0.4, 0.4, 1.8)}


def ego_pose(tick: int) -> np.ndarray:
    return pose(10.0 + 0.5 * tick, 5.0, 0.1, 0.3, np.radians(-1.0))


def other_pose(tick: int) -> np.ndarray:
    return pose(20.0 + 0.8 * tick, 9.0, 0.0, 0.2)


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """Return classes that have the modules, names and fields of the recorder's."""
    fields = {
        "utils.label_types": {"ObjectLabel": "frame timestamp label_type carla_id transform bounding_box"},
        "utils.geometry_types": {
            "Location": "x y z",
            "Vector3d": "x y z",
            "Rotation": "roll pitch yaw",
            "Transform": "location rotation",
            "BoundingBox": "location extent rotation",
        },
    }
    made = {}
    for module, classes in fields.items():
        monkeypatch.setitem(sys.modules, module, types.ModuleType(module))
        for name, own in classes.items():

            def fill(self: Any, *values: Any, names: tuple[str, ...] = tuple(own.split())) -> None:
                self.__dict__.update(zip(names, values, strict=True))

            made[name] = type(name, (), {"__module__": module, "__init__": fill})
            setattr(sys.modules[module], name, made[name])
    monkeypatch.setitem(sys.modules, "utils", types.ModuleType("utils"))
    return types.SimpleNamespace(**made)


def angles(matrix: np.ndarray) -> dict[str, float]:
    """Return x, y, z [m], roll, pitch, yaw [degrees], right-handed."""
    yaw, pitch = np.arctan2(matrix[1, 0], matrix[0, 0]), -np.arcsin(matrix[2, 0])
    roll = np.arctan2(matrix[2, 1], matrix[2, 2])
    turned = np.degrees((roll, pitch, yaw)).tolist()
    return dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), [*matrix[:3, 3].tolist(), *turned], strict=True))


def make_label(recorder: Any, tick: int, kind: str, number: int, place: np.ndarray, size: tuple[float, ...]) -> Any:
    own = angles(place)
    turn, upright = recorder.Rotation(own["roll"], own["pitch"], own["yaw"]), recorder.Rotation(0.0, -0.0, -0.0)
    box = recorder.BoundingBox(
        recorder.Location(0.1, -0.0, size[2] / 2), recorder.Vector3d(*(side / 2 for side in size)), upright
    )
    where = recorder.Transform(recorder.Location(own["x"], own["y"], own["z"]), turn)
    return recorder.ObjectLabel(FIRST + tick, 60.0 + 0.1 * tick, kind, number, where, box)


def make_labels(recorder: Any, tick: int) -> list[Any]:
    parked = 17293822569102704640 + tick * 0  # a number of a parked car has 64 bits
    return [
        make_label(recorder, tick, "vehicle", parked, pose(25.0, 0.0, 0.0), SIZES["vehicle"]),
        make_label(recorder, tick, "vehicle", 31, ego_pose(tick), SIZES["vehicle"]),
        make_label(recorder, tick, "vehicle", 44, other_pose(tick), SIZES["vehicle"]),
        make_label(recorder, tick, "pedestrian", 45, pose(18.0, 2.0, 0.0), SIZES["pedestrian"]),
        make_label(recorder, tick, "vehicle", 46, pose(21.0, 3.0, 0.0), (1.8, 0.0, 1.5)),  # a bicycle of CARLA's
        make_label(recorder, tick, "vehicle", 47, pose(900.0, 3.0, 0.0), SIZES["vehicle"]),
    ]


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:  # in text mode, as the recorder's
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_sensor(folder: Path, place: Callable[[int], np.ndarray]) -> None:
    rows = [{"frame": FIRST + tick, "timestamp": 60.0 + 0.1 * tick, **angles(place(tick))} for tick in range(TICKS)]
    write_rows(folder / "poses.csv", rows)


def points_at(world_from_lidar: np.ndarray, tick: int) -> np.ndarray:
    """Return points within the other car, in the LiDAR's frame."""
    within = transform_points(other_pose(tick) @ pose(0.1, 0, 0.75), CORNERS)
    return np.column_stack((transform_points(inverse(world_from_lidar), within), np.linspace(0, 1, 8))).astype("<f4")


def make_recording(recorder: Any, root: Path, protocol: int = 4) -> None:
    """Write a recording: a vehicle with LiDAR, camera and what has no place in a dataset, a post with a LiDAR."""
    (root / "others.world_0").mkdir(parents=True)
    vehicle, post = root / "vehicle.tesla.model3_1", root / "others.infrastructure_9"
    for tick in range(TICKS):
        name = f"{FIRST + tick:010d}"
        (root / "others.world_0" / f"{name}.pkl").write_bytes(pickle.dumps(make_labels(recorder, tick), protocol))
        for folder in (vehicle / "velodyne", vehicle / "sensor.other.radar_4", vehicle / "semantic", post / "lidar"):
            folder.mkdir(parents=True, exist_ok=True)
        np.save(vehicle / "velodyne" / name, points_at(ego_pose(tick) @ LIDAR, tick))
        np.save(post / "lidar" / name, points_at(POST, tick))
        np.save(vehicle / "sensor.other.radar_4" / name, np.zeros((5, 7)))
        kinds = [*((axis, np.float32) for axis in ("x", "y", "z", "CosAngle")), ("ObjIdx", np.uint32)]
        np.save(vehicle / "semantic" / name, np.zeros(4, np.dtype([*kinds, ("ObjTag", np.uint32)])))
        (vehicle / "image_2").mkdir(exist_ok=True)
        picture = np.full((HEIGHT, WIDTH, 4), (200, 100, 10 * tick, 255), np.uint8)  # of four channels
        Image.fromarray(picture).save(vehicle / "image_2" / f"{name}.png")
    write_sensor(vehicle / "velodyne", lambda tick: ego_pose(tick) @ LIDAR)
    write_sensor(vehicle / "image_2", lambda tick: ego_pose(tick) @ FRONT @ OPTICAL)
    write_sensor(post / "lidar", lambda _: POST)
    lens = {"cx": WIDTH / 2, "width": WIDTH, "fy": FOCAL, "height": HEIGHT, "cy": HEIGHT / 2, "fx": FOCAL}
    write_rows(vehicle / "image_2" / "camera_info.csv", [lens])
    control = {"speed": 18.0, "vx": 5.0, "throttle": 0.4, "reverse": False, "gear": 1}
    status = [
        {"frame": FIRST + tick, "timestamp": 60.0 + 0.1 * tick, **angles(ego_pose(tick)), **control}
        for tick in range(TICKS)
    ]
    write_rows(vehicle / "vehicle_status.csv", status)
    (root / "carla_raw_record.log").write_text("of CARLA's own recorder")


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_a_recording_is_read_as_it_was_made(recorder: Any, tmp_path: Path, protocol: int) -> None:
    make_recording(recorder, tmp_path / "raw_data" / "record_2022_0113_1337", protocol)
    notes = import_dataset("carlaflcav", tmp_path / "raw_data", tmp_path / "out")
    assert notes == (
        "left out 1 semantic LiDAR, which has no intensities",
        "left out 1 radar, which has no radar cross-sections",
        "left out 3 labels of objects without a volume",
    )
    assert validate(tmp_path / "out") == []
    data = Dataset.open(tmp_path / "out")
    assert [(key.scene, key.index, key.agent, round(key.time_s, 6)) for key in data.keys] == [
        ("record_2022_0113_1337", tick, agent, round(0.1 * tick, 6))
        for tick in range(TICKS)
        for agent in ("cav0", "pole0")
    ]
    car, post = data.frame(2), data.frame(3)
    np.testing.assert_allclose(car.world_from_agent, ego_pose(1), atol=1e-9)
    np.testing.assert_allclose(car.calibration.agent_from_sensor["velodyne"], LIDAR, atol=1e-12)
    np.testing.assert_allclose(car.calibration.agent_from_sensor["image_2"], FRONT @ OPTICAL, atol=1e-12)
    np.testing.assert_allclose(post.world_from_agent, POST, atol=1e-9)
    np.testing.assert_array_equal(car.lidar["velodyne"], points_at(ego_pose(1) @ LIDAR, 1))
    assert (car.images["image_2"].rgb == (200, 100, 10)).all()
    found = car.annotations
    assert found.track.tolist() == ["17293822569102704640", "44", "45"]  # neither itself, nor flat, nor far away
    assert found.boxes.label.tolist() == ["car", "car", "pedestrian"]
    np.testing.assert_allclose(found.boxes.center[1], (other_pose(1) @ pose(0.1, 0.0, 0.75))[:3, 3], atol=1e-9)
    np.testing.assert_allclose(found.boxes.size[1:], [SIZES["vehicle"], SIZES["pedestrian"]])
    np.testing.assert_allclose(found.boxes.yaw, [0.0, 0.2, 0.0], atol=1e-9)
    assert found.returns.tolist() == [0, 8, 0]
    np.testing.assert_allclose(found.velocity[1], [8.0, 0.0, 0.0], atol=1e-6)
    assert post.annotations.track.tolist() == ["17293822569102704640", "31", "44", "45"]
    assert post.annotations.returns.tolist() == [0, 0, 8, 0]
    middle = found.views["image_2"].amodal_box[2].reshape(2, 2).mean(axis=0)
    ray = transform_points(inverse(ego_pose(1) @ FRONT @ OPTICAL), found.boxes.center[2:])[0]
    np.testing.assert_allclose(middle, FOCAL * ray[:2] / ray[2] + (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5), atol=1.5)


def test_one_recording_several_and_a_name_of_ones_own(recorder: Any, tmp_path: Path) -> None:
    for name in ("record_a", "record_b"):
        make_recording(recorder, tmp_path / "raw" / name)
        (tmp_path / "raw" / name / "vehicle.tesla.model3_1").rename(tmp_path / "raw" / name / "first")
    import_dataset("carlaflcav", tmp_path / "raw" / "record_a", tmp_path / "one")
    import_dataset("carlaflcav", tmp_path / "raw", tmp_path / "both")
    assert {key.scene for key in Dataset.open(tmp_path / "both").keys} == {"record_a", "record_b"}
    agents = {key.agent for name in ("one", "both") for key in Dataset.open(tmp_path / name).keys}
    assert agents == {"cav0", "pole0"}  # of both recordings, whose rigs are the same


def test_frames_that_lack_a_file_are_left_out_and_counted(recorder: Any, tmp_path: Path) -> None:
    root = tmp_path / "record"
    make_recording(recorder, root)
    (root / "others.world_0" / f"{FIRST:010d}.pkl").unlink()
    (root / "vehicle.tesla.model3_1" / "velodyne" / f"{FIRST + 1:010d}.npy").unlink()
    (root / "vehicle.tesla.model3_1" / "image_2" / f"{FIRST + 2:010d}.png").unlink()
    notes = import_dataset("carlaflcav", root, tmp_path / "out")
    assert notes[0] == (
        "left out 3 of 6 frames: no labels, or not all of a LiDAR: vehicle.tesla.model3_1/1207, "
        "vehicle.tesla.model3_1/1208, others.infrastructure_9/1207"
    )
    data = Dataset.open(tmp_path / "out")
    assert [(key.index, key.agent, key.time_s) for key in data.keys] == [
        (0, "pole0", 0.0), (1, "cav0", 0.1), (1, "pole0", 0.1)
    ]  # fmt: skip
    assert not data.frame(1).images


def replaced(old: str, new: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(path.read_text().replace(old, new))


def saved(values: np.ndarray) -> Callable[[Path], object]:
    return lambda path: np.save(path, values)


def cut(path: Path) -> object:
    return path.write_bytes(path.read_bytes()[:-20])


DAMAGE: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "labels cut": ("others*/*.pkl", cut, "not labels of CarlaFLCAV"),
    "labels of nothing": ("others*/*.pkl", lambda path: path.write_bytes(b""), "not labels of CarlaFLCAV"),
    "a table without y": ("vehicle*/velodyne/poses.csv", replaced("y", "why"), "no column 'y' of numbers"),
    "a pose of words": ("vehicle*/velodyne/poses.csv", replaced("1207", "one"), "no column 'frame' of numbers"),
    "an endless pose": ("vehicle*/vehicle_status.csv", replaced("1207", "1e99"), "'frame' is not finite, or too large"),
    "points cut": ("vehicle*/velodyne/*.npy", cut, "not a readable NumPy array"),
    "points of objects": ("vehicle*/velodyne/*.npy", saved(np.array([{}, 1])), "not a readable NumPy array"),
    "points of five": ("vehicle*/velodyne/*.npy", saved(np.zeros((4, 5), "<f4")), "which no sensor of CarlaFLCAV has"),
    "points of a radar": ("vehicle*/velodyne/*.npy", saved(np.zeros((4, 7))), "no sweep of a LiDAR"),
    "a point nowhere": ("vehicle*/velodyne/*.npy", saved(np.full((4, 4), np.nan, "<f4")), "point 0 is not finite"),
    "a picture cut": ("vehicle*/image_2/*.png", cut, "a truncated image"),
    "a lens of nothing": ("vehicle*/image_2/camera_info.csv", replaced("32.0", "0"), "fx"),
    "a wider lens": ("vehicle*/image_2/camera_info.csv", replaced("64", "65"), "64 x 32 pixels, not those"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_one_sentence(
    recorder: Any, damage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "record"
    make_recording(recorder, root)
    pattern, change, told = DAMAGE[damage]
    path = sorted(root.glob(pattern))[-1]
    change(path)
    with pytest.raises(SystemExit) as stopped:
        run(["import", "carlaflcav", str(root), "--out", str(tmp_path / "out")])
    assert stopped.value.code == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"flcav: {path.parent}")
    assert told in said
    assert "\n" not in said


def test_a_header_of_an_array_allocates_nothing(recorder: Any, tmp_path: Path) -> None:
    make_recording(recorder, tmp_path / "record")
    path = min((tmp_path / "record").glob("vehicle*/velodyne/*.npy"))
    path.write_bytes(path.read_bytes().replace(b"(8, 4), }         ", b"(8000000000000, 4)")[:128] + b"}")
    with pytest.raises(InputError, match="not a readable NumPy array"):
        import_dataset("carlaflcav", tmp_path / "record", tmp_path / "out")


# ---- pickles that are made to do harm


class Called:
    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("called",)


TRAP = b"cos\nsystem\n(S'touch trapped'\ntR."
NAMED = b"cutils.geometry_types\nTransform\n"
EVIL: dict[str, bytes] = {
    "reduce": pickle.dumps([Called()]),
    "os.system, protocol 0": TRAP,
    "os.system, stack global": b"\x80\x04\x8c\x05posix\x94\x8c\x06system\x94\x93\x8c\x04true\x85R.",
    "inst": b"(S'true'\nios\nsystem\n.",
    "obj": b"(cos\nsystem\nS'true'\no.",
    "newobj with arguments": b"\x80\x02" + NAMED + b"K\x01\x85\x81.",
    "newobj of no class": b"\x80\x02K\x01)\x81.",
    "newobj_ex": b"\x80\x04" + NAMED + b")}\x92.",
    "build of a class": b"\x80\x02" + NAMED + b"}X\x01\x00\x00\x00xK\x01sb.",
    "build of a list": b"\x80\x02]}b.",
    "build by slots": b"\x80\x02" + NAMED + b")\x81N}\x86b.",
    "dunder of a class": b"\x80\x04\x8c\x14utils.geometry_types\x8c\x12Transform.__init__\x93.",
    "a class within": b"cutils.label_types\nObjectLabel.__class__\n.",
    "a module within": b"cutils.geometry_types\nnumpy.load\n.",
    "global of a tuple": b"\x80\x04)\x8c\x06system\x93.",
    "global of a nest": b"\x80\x04" + b"]" * 50_000 + b"a" * 49_999 + b"\x8c\x06system\x93.",
    "extension": b"\x80\x02\x82\x01.",
    "persistent": b"Pid\n.",
    "binary persistent": b"K\x01Q.",
    "buffer": b"\x80\x05\x97.",
    "memo of nothing": b"\x80\x02j\xff\xff\xff\x7f.",
    "huge text": b"\x80\x04\x8d" + b"\xff" * 7 + b"\x7f" + b"a.",
    "huge number": b"\x80\x02\x8b\xff\xff\xff\x7f\x01.",
    "deep lists": b"\x80\x02" + b"]" * 300_000 + b"a" * 299_999 + b".",
    "a list within itself": b"\x80\x02]q\x00h\x00a.",
    "a record within itself": b"\x80\x02]" + NAMED + b")\x81q\x00}X\x09\x00\x00\x00transformh\x00sba.",
    "one label a million times": b"\x80\x02]" + NAMED + b")\x81q\x00(" + b"h\x00" * 1_000_000 + b"e.",
    "an unhashable key": b"\x80\x02}]K\x01s.",
    "a dictionary": b"\x80\x02}.",
    "numbers": b"\x80\x02]K\x01a.",
    "pop from nothing": b"\x80\x020.",
    "nothing to append": b"\x80\x02a.",
    "no end": b"\x80\x02]",
    "words": b"hello",
    "a gap": b"\x80\x02]" + b"N0" * 10 + b".",
    "a large file": b"\x80\x02]" + b"K\x010" * MOST_BYTES + b".",
}


BOUNDED: dict[str, bytes] = {  # what would take memory or depth, and stands for no labels
    "huge memo": b"\x80\x02]r\xff\xff\xff\x7f.",
    "huge frame": b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f].",
    "deep marks": b"\x80\x02]" + b"(" * 300_000 + b"e" * 300_000 + b".",
    "another protocol": b"\x80\x09].",
}


@pytest.fixture
def no_unpickling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the interpreter tell of whatever is called or imported by a file."""
    monkeypatch.setattr(pickle, "Unpickler", None)
    monkeypatch.setattr(pickle, "load", None)
    monkeypatch.setattr(pickle, "loads", None)


@pytest.mark.parametrize("name", EVIL)
@pytest.mark.usefixtures("no_unpickling")
def test_a_pickle_that_does_harm_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    known = set(sys.modules)
    (tmp_path / "labels.pkl").write_bytes(EVIL[name])
    with pytest.raises(InputError, match=r"^labels\.pkl: not labels of CarlaFLCAV") as told:
        read_labels(Path("labels.pkl"))
    assert len(str(told.value)) < 300
    assert str(told.value).isprintable()
    assert [path.name for path in tmp_path.iterdir()] == ["labels.pkl"]
    assert capsys.readouterr().out == ""
    assert not {module for module in set(sys.modules) - known if module.startswith(("utils", "posix"))}


@pytest.mark.parametrize("name", BOUNDED)
@pytest.mark.usefixtures("no_unpickling")
def test_sizes_that_a_pickle_claims_take_no_memory(name: str, tmp_path: Path) -> None:
    (tmp_path / "labels.pkl").write_bytes(BOUNDED[name])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert len(read_labels(tmp_path / "labels.pkl").track) == 0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


def test_pickles_that_do_harm_do_harm_when_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the refusals above are of something."""
    monkeypatch.chdir(tmp_path)
    pickle.loads(TRAP)
    assert (tmp_path / "trapped").exists()


@settings(max_examples=300, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_bytes_at_random_are_labels_or_one_sentence(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    draw = random.Random(seed)
    codes = [code.code.encode("latin1") for code in pickletools.opcodes]
    parts = [*codes, NAMED, b"X\x01\x00\x00\x00x", b"K\x01", b"q\x00", b"h\x00", draw.randbytes(3)]
    path = tmp_path_factory.mktemp("random") / "labels.pkl"
    path.write_bytes(b"\x80\x04" + b"".join(draw.choices(parts, k=draw.randrange(40))) + b".")
    with contextlib.suppress(InputError):
        assert len(read_labels(path).track) == 0


@pytest.mark.parametrize("protocol", [2, 4])
def test_labels_are_what_python_unpickles(recorder: Any, protocol: int, tmp_path: Path) -> None:
    """Of trusted bytes, of more labels than pickle puts in one batch, with shared objects."""
    shared = recorder.Rotation(0.0, 0.0, 0.0)
    made = [make_label(recorder, 0, "vehicle", n, pose(n, -n, 0.5, 0.001 * n), (4, 2, 1.5)) for n in range(1500)]
    for label in made:
        label.bounding_box.rotation = shared
    (tmp_path / "labels.pkl").write_bytes(pickle.dumps(made, protocol))
    found = read_labels(tmp_path / "labels.pkl")
    trusted = pickle.load(io.BytesIO((tmp_path / "labels.pkl").read_bytes()))
    assert found.track.tolist() == [str(label.carla_id) for label in trusted]
    places = [[getattr(label.transform.location, axis) for axis in "xyz"] for label in trusted]
    np.testing.assert_allclose(found.world_from_actor[:, :3, 3], places)
    np.testing.assert_allclose(found.size, [(4, 2, 1.5)] * 1500)
