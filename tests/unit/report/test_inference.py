"""Findings of any task are drawn by their marks: each kind, together, and of classes that nobody has heard of."""

from pathlib import Path

import numpy as np
import pytest

from flcav.geometry import Boxes
from flcav.perception.images import CameraView
from flcav.perception.marks import Bars, CloudBoxes, Light, Mark, Mode, Paths, PictureBoxes, RoadUser
from flcav.perception.objects.predict import ObjectsFound
from flcav.perception.task import Finding
from flcav.report import style
from flcav.report.pictures.inference import DRAWERS, SIDE, draw

PICTURE = np.full((60, 90, 3), 128, np.uint8)
CLOUD = np.random.default_rng(0).uniform((1, -9, -2, 0), (40, 9, 1, 1), (200, 4)).astype(np.float32)
MAP = np.zeros((3, 40, 40), np.bool_)
CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])  # looks along the cloud's x
VIEW = CameraView(PICTURE, CAMERA, np.array([[50, 0, 45], [0, 50, 30], [0, 0, 1.0]]), np.zeros(5))
SHARES = Bars({"dry": 0.7, "wet": 0.3})
PLATES = PictureBoxes(np.array([[5, 5, 30, 20.0]]), np.array(["number_plate"]), np.array([0.8]))
TRAILERS = CloudBoxes(Boxes.from_array([[12, 1, 0, 8, 2, 3, 0.2]] * 2, ["Trailer", "Car"], [0.9, 0.5]))
USER = RoadUser("veh0", "car", 5.0, 2.0, 0.1, 8.0, 4.4, 1.8, (Mode(0.6, np.array([[6, 2], [8, 2.5]])),))
WAYS = Paths((0.0, 0.0, 0.0), 20.0, (0.5, 1.0), (USER,), (Light(3.0, 1.0, True),))


NOTHING = ObjectsFound(())


@pytest.mark.parametrize(
    ("seen", "marks", "title", "axes"),
    [
        (PICTURE, (), "input", 1),
        (PICTURE, (PLATES,), "input · 1 found", 1),
        (PICTURE, (PLATES, SHARES), "input · 1 found · dry", 2),
        (CLOUD, (SHARES,), "input · dry", 4),
        (CLOUD, (TRAILERS, SHARES, SHARES), "input · 2 found · dry · dry", 5),
        (MAP, (WAYS,), "input · 1 predicted", 1),
        (MAP, (WAYS, SHARES), "input · 1 predicted · dry", 2),
    ],
)
def test_marks_are_drawn_on_what_was_seen(seen: np.ndarray, marks: tuple[Mark, ...], title: str, axes: int):
    figure = draw(Finding(Path("input.png").with_suffix(""), seen, NOTHING, marks, lambda: VIEW))
    assert title in [each.get_title("left") for each in figure.axes]
    assert len(figure.axes) == axes
    assert style.png(figure, dpi=40).startswith(b"\x89PNG")


def test_every_class_has_its_legend_whoever_named_it():
    figure = draw(Finding(Path("input"), CLOUD, NOTHING, (TRAILERS,)))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["1 Car", "1 Trailer"]


def test_every_kind_of_mark_has_a_drawer():
    assert set(DRAWERS) | set(SIDE) == set(Mark.__args__)
