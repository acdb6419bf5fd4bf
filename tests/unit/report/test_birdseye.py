import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from flcav.geometry import Boxes
from flcav.report import style
from flcav.report.pictures.birdseye import View, birdseye


def view(**fields: object) -> View:
    points = np.random.default_rng(0).uniform((-40, -40, 0), (40, 40, 6), (3000, 3))
    truth = Boxes.from_array([[20, 10, 1, 4, 2, 1.5, 0.3], [-20, 10, 1, 4, 2, 1.5, 0]], "car")
    base = View(points=points, truth=truth, returns=np.array([30, 0]), title="a frame", agent_size=(4.5, 1.8))
    return replace(base, **fields)


def pixels(seen: View) -> np.ndarray:
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
