import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from matplotlib.colors import to_hex
from PIL import Image

from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.report import style
from flcav.report.pictures.birdseye import BirdseyeView, birdseye, view_frame
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

UP = {"mount": {"z": 1.8}}
RIG = {"lidars": {"lidar": UP}, "radars": {"radar": UP}}


def view(**fields: object) -> BirdseyeView:
    points = np.random.default_rng(0).uniform((-40, -40, 0), (40, 40, 6), (3000, 3))
    truth = Boxes.from_array([[20, 10, 1, 4, 2, 1.5, 0.3], [-20, 10, 1, 4, 2, 1.5, 0]], "car")
    base = BirdseyeView(points=points, truth=truth, returns=np.array([30, 0]), title="a frame", agent_size=(4.5, 1.8))
    return replace(base, **fields)


def pixels(seen: BirdseyeView) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(style.png(birdseye(seen), dpi=60))).convert("RGB")).astype(int)


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    return pixels(view())


def test_the_same_view_gives_the_same_picture(plain: np.ndarray):
    np.testing.assert_array_equal(pixels(view()), plain)


@pytest.mark.parametrize(
    "change",
    [
        {"predictions": Boxes.from_array([[10, 0, 1, 4, 2, 1.5, 0]], "car")},
        {"returns": np.array([30, 5])},
        {"agent_size": None},
        {"echoes": np.array([[15.0, -8.0, -3.0]])},
        {"tracks": [np.array([[20.0, 10.0], [30.0, 12.0]])]},
        {"range_m": 80.0},
        {"points": np.zeros((0, 3))},
        {"truth": Boxes.empty(), "returns": np.zeros(0, int)},
    ],
)
def test_everything_in_the_view_shows(plain: np.ndarray, change: dict):
    assert np.abs(plain - pixels(view(**change))).max() > 50


def test_ahead_is_up_and_left_is_left():
    axes = birdseye(view(points=np.array([[30.0, 10.0, 2.0]]))).axes[0]
    offsets = [np.asarray(points.get_offsets()) for points in axes.collections]
    assert any(offset.shape == (1, 2) and np.allclose(offset, [[-10.0, 30.0]]) for offset in offsets)


def test_heading_ticks_leave_through_the_front():
    axes = birdseye(view()).axes[0]
    paths = [np.asarray(path.vertices) for lines in axes.collections for path in lines.get_paths()]
    expected = np.array([20, 10]) + 2.6 * np.array([np.cos(0.3), np.sin(0.3)])
    assert any(len(path) == 2 and np.allclose(path[-1], [-expected[1], expected[0]]) for path in paths)


def test_echoes_are_coloured_by_their_range_rate():
    echoes = np.array([[10.0, 0.0, -4.0], [20.0, 0.0, 4.0], [30.0, 0.0, 0.1]])
    axes = birdseye(view(points=np.zeros((0, 3)), echoes=echoes)).axes[0]
    drawn = [(np.asarray(each.get_offsets()), np.asarray(each.get_facecolor())) for each in axes.collections]
    found = {tuple(at[0]): to_hex(colours[0].tolist()) for at, colours in drawn if len(at) == 1 and len(colours)}
    expected = {(0.0, 10.0): style.BLUE, (0.0, 20.0): style.VERMILLION, (0.0, 30.0): style.MUTED}
    assert expected.items() <= found.items()


def test_echoes_and_paths_of_a_recording_lie_on_the_actors(tmp_path: Path):
    source = EmbeddedSource(Recipe(town="suburb", seed=4, spins_per_scene=3, vehicle_rig=RIG))  # pyright: ignore
    record(source, tmp_path / "data")
    dataset = Dataset.open(tmp_path / "data")
    frame = dataset.frame(1)
    seen = view_frame(dataset, frame, range_m=50, tracks=True)
    assert seen.echoes is not None
    assert len(seen.echoes) == len(frame.radar["radar"])
    assert (seen.echoes[:, 0] > 0).all()  # the radar looks ahead
    polygons = np.asarray(shapely.polygons(seen.truth.corners()[:, :4, :2]))
    distance = shapely.distance(np.asarray(shapely.points(seen.echoes[:, :2]))[:, None], polygons[None])
    of_actors = frame.annotations.points["radar"]
    assert (np.sort(distance.min(axis=0))[: np.count_nonzero(of_actors)] < 1.5).all()
    now = seen.truth.center[:, :2]
    whole = [path for path in seen.tracks if len(path) == 3]
    assert whole
    assert all(np.linalg.norm(now - path[1], axis=1).min() < 1e-6 for path in whole)
    assert not view_frame(dataset, frame, range_m=50).tracks
