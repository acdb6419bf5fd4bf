"""What cameras saw, drawn: against the annotations' own rectangles, and what can be seen by eye."""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from PIL import Image

from flcav.cli.main import run
from flcav.dataset.store import Dataset
from flcav.report import style
from flcav.report.pictures.camera import CameraShot, arrange_cameras, camera_sheet, make_shot, thermal_grey
from flcav.sensors.frame import Frame
from flcav.sensors.observe import observe
from flcav.sensors.rig import RIGS, Rig
from flcav.world.scene import Scene

STREET = [
    ("cav0", "car", 3, 0.0, -2.0, 0.0),
    ("veh1", "car", 0, 12.0, -2.0, 0.1),
    ("veh2", "van", 1, 17.0, 3.5, np.pi),
    ("veh3", "bicycle", 0, 9.0, 2.0, 2.0),
    ("ped4", "pedestrian", 0, 7.0, 4.0, 1.0),
    ("veh5", "truck", 0, -14.0, -2.0, 0.0),
]
LENS = {"width": 320, "height": 192, "fov_deg": 80.0, "k1": -0.1}
RIG = Rig.model_validate(
    {
        "cameras": {
            "aside": {"mount": {"x": 0.4, "z": 1.5, "yaw_deg": 60.0}, "settings": LENS},
            "front": {"mount": {"x": 0.4, "z": 1.5}, "settings": LENS, "trigger_ms": 80.0},
            "rear": {"mount": {"z": 1.5, "yaw_deg": 180.0}, "settings": LENS},
        },
        "infrareds": {
            "warm": {"mount": {"x": 0.4, "z": 1.5, "yaw_deg": -20.0}, "settings": {"width": 160, "height": 96}}
        },
    }
)
SPEED_M_S = 15.0


@pytest.fixture(scope="module")
def frame(small_town, standing) -> Frame:
    """Everybody is under way, so that a camera that looks later sees them elsewhere."""
    trace = standing(STREET, instants=2)
    heading = np.stack((np.cos(trace.yaw), np.sin(trace.yaw), 0 * trace.yaw), axis=-1)
    moving = replace(trace, velocity=SPEED_M_S * heading)
    return observe(Scene(small_town(), moving), RIG, "cav0", 0, scene_name="s", seed=1)


@pytest.fixture(scope="module")
def data(frame: Frame, recorded: Callable[[Frame, Path], Dataset], tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return recorded(frame, tmp_path_factory.mktemp("camera") / "data")


def pixels(rows: list[list[CameraShot]], *, boxes: bool) -> np.ndarray:
    png = style.png(camera_sheet("a frame", rows, boxes=boxes), dpi=60)
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def called(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        run([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@pytest.mark.parametrize("camera", ["front", "warm", "rear"])
def test_a_box_is_around_the_rectangle_of_its_actor_when_the_camera_looks(frame: Frame, camera: str):
    seen, views = make_shot(frame, camera), frame.annotations.views[camera]
    drawn = dict(zip(seen.track.tolist(), seen.view.project(seen.boxes.corners().reshape(-1, 3)).reshape(-1, 8, 2)))
    tracks = frame.annotations.track.tolist()
    whole = [row for row, track in enumerate(tracks) if track in drawn and not views.truncation[row]]
    assert whole
    for row in whole:
        corners = drawn[tracks[row]]
        box = np.concatenate((corners.min(axis=0), corners.max(axis=0)))
        rectangle = views.amodal_box[row]
        around = np.concatenate((rectangle[:2] - box[:2], box[2:] - rectangle[2:]))
        assert around.min() > -0.5, tracks[row]
        assert around.max() < 3 + 0.3 * np.ptp(corners, axis=0).max()


def test_only_what_shows_is_drawn(frame: Frame):
    for camera, views in frame.annotations.views.items():
        shows = frame.annotations.track[views.pixels > 0]
        np.testing.assert_array_equal(make_shot(frame, camera).track, shows)
    assert set(make_shot(frame, "rear").track) == {"veh5"}


def test_a_tick_leaves_each_box_through_its_front(frame: Frame):
    seen = make_shot(frame, "front")
    axes = camera_sheet("a frame", [[seen]], boxes=True).axes[0]
    drawn = [line for lines in axes.collections if isinstance(lines, LineCollection) for line in lines.get_segments()]
    (row,) = np.flatnonzero(seen.track == "veh1")
    box = seen.boxes[[row]]
    heading = np.array([np.cos(box.yaw[0]), np.sin(box.yaw[0]), 0.0])
    foot = box.center[0] - (0, 0, box.size[0, 2] / 2)
    tip = foot + 1.3 * box.size[0, 0] / 2 * heading
    ends = seen.view.project(np.stack((foot, tip)))
    assert any(np.allclose(line[[0, -1]], ends, atol=1e-6) for line in drawn)


def test_cameras_stand_as_one_looks_at_them(frame: Frame):
    assert arrange_cameras(frame, [*RIG.cameras, "warm"]) == [["aside", "front", "warm"], ["rear"]]
    assert arrange_cameras(frame, ["rear", "warm", "front"]) == [["front", "warm", "rear"]]


def test_a_car_s_six_cameras_are_in_two_rows(small_town, standing):
    scene = Scene(small_town(), standing(STREET))
    small = {name: sensor.model_dump() for name, sensor in RIGS["car_surround"].cameras.items()}
    for sensor in small.values():
        sensor["settings"] |= {"width": 32, "height": 16}
    seen = observe(scene, Rig.model_validate({"cameras": small}), "cav0", 0, scene_name="s", seed=1)
    rows = arrange_cameras(seen, sorted(small))
    assert rows == [["front_left", "front", "front_right"], ["back_left", "back", "back_right"]]


def test_the_picture_shows_what_it_is_asked_for(frame: Frame):
    rows = [
        [make_shot(frame, name) for name in row] for row in arrange_cameras(frame, [*frame.images, *frame.infrared])
    ]
    plain, drawn = pixels(rows, boxes=False), pixels(rows, boxes=True)
    np.testing.assert_array_equal(pixels(rows, boxes=False), plain)
    assert drawn.shape[0] > plain.shape[0]  # the key
    alone = pixels([[make_shot(frame, "front")]], boxes=False)
    picture = np.asarray(Image.fromarray(frame.images["front"].rgb).resize((16, 8), Image.Resampling.BOX)).astype(int)
    inside = Image.fromarray(alone[30:-4, 6:-6].astype(np.uint8)).resize((16, 8), Image.Resampling.BOX)
    assert np.abs(np.asarray(inside).astype(int) - picture).mean() < 12


def test_warm_is_bright():
    image = np.arange(25_000, 31_000, dtype=np.uint16).reshape(60, 100)
    grey = thermal_grey(image)
    assert (np.diff(grey[..., 0].ravel().astype(int)) >= 0).all()
    assert np.ptp(grey) > 200
    assert np.ptp(thermal_grey(np.full((4, 4), 29_000, np.uint16))) == 0


def test_the_command_draws_one_camera_or_all(data: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    sizes = {}
    for name, options in (
        ("all", ()),
        ("boxes", ("--boxes",)),
        ("one", ("--camera", "front", "--frame", data.name(0))),
    ):
        out = tmp_path / f"{name}.png"
        assert called("camera", data.folder, "--out", out, *options) == 0
        told = capsys.readouterr().out
        assert told == f"{out}: {data.name(0)}, {'front' if name == 'one' else 'aside, front, warm, rear'}\n"
        with Image.open(out) as picture:
            sizes[name] = picture.size
    assert sizes["all"][0] > sizes["one"][0]


def test_what_is_not_there_is_one_sentence(
    data: Dataset, frame: Frame, recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    blind = replace(frame, images={}, infrared={}, annotations=replace(frame.annotations, views={}, signs={}))
    without = recorded(blind, tmp_path / "blind").folder
    out = tmp_path / "out.png"
    cases = {
        "no camera 'top' in s_0000_cav0; it has aside, front, rear, warm": (data.folder, "--camera", "top"),
        "no frame 'nowhere'": (data.folder, "--frame", "nowhere"),
        "no frame has a camera's picture": (without,),
        "frame s_0000_cav0 has no camera's picture": (without, "--frame", "s_0000_cav0"),
        "manifest": (tmp_path,),
    }
    for sentence, (folder, *options) in cases.items():
        assert called("camera", folder, "--out", out, *options) == 2
        told = capsys.readouterr()
        assert (told.out, told.err.count("\n")) == ("", 1)
        assert sentence in told.err
    assert not out.exists()
