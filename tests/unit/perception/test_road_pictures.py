"""Cars in pictures of roadside cameras: their labels, and the background that pictures are seen beside."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from flcav.config import InputError
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.perception.signs import predict
from flcav.perception.signs.model import CONFIGURATIONS, SignDetector
from flcav.perception.signs.predict import SignDetections, detect_signs
from flcav.perception.signs.samples import (
    RecordedPictures,
    compare_with_background,
    draw_mosaic,
    label_picture,
    learn_picture_background,
    picture_reader,
)
from flcav.perception.signs.task import SIGNS
from flcav.sensors.frame import Annotations, Frame, Views
from perception.frames import frame

ROAD = CONFIGURATIONS["road"]
GREY, RED = 100, (200, 20, 30)
NOTHING = SignDetections(np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros(0))


class Street:
    """Pictures of a grey street by one camera of a pole; a red car stands elsewhere in each."""

    def __init__(self, agent: str = "pole1", pictures: int = 5) -> None:
        self.folder, self.agent, self.pictures = Path("street"), agent, pictures

    def select(self, *, agents: set[str]) -> list[int]:
        return list(range(self.pictures)) if agents == {self.agent} else []

    def numbers(self, frames: list[int] | None) -> list[int]:
        return list(range(self.pictures)) if frames is None else frames

    def frame(self, number: int) -> Frame:
        return frame([], agent=self.agent)

    def check_labelled(self, what: str) -> None:
        assert what == "objects"

    def cameras(self, number: int) -> list[str]:
        return ["left"]

    def name(self, number: int) -> str:
        return f"s_{number:04d}_{self.agent}"

    @property
    def keys(self) -> list:
        return [self.frame(number) for number in range(self.pictures)]

    def plane(self, number: int, camera: str, plane: str) -> np.ndarray:
        picture = np.full((64, 96, 3), GREY, np.uint8)
        picture[20:30, 15 * number : 15 * number + 12] = RED
        return picture


STREET = cast("Dataset", Street())


def test_the_background_is_the_street_without_what_moves() -> None:
    assert (learn_picture_background(STREET, "pole1", "left") == GREY).all()


def test_a_background_is_learned_from_three_pictures_or_more() -> None:
    assert (learn_picture_background(cast("Dataset", Street(pictures=3)), "pole1", "left") == GREY).all()
    for pictures, told in ((1, "1 picture"), (2, "2 pictures")):
        few = cast("Dataset", Street(pictures=pictures))
        with pytest.raises(InputError, match=rf"^street: pole1 has {told} by left, .* 3 or more; record more"):
            picture_reader(few, background=True)(0, "left")


def test_a_picture_is_seen_beside_its_background() -> None:
    seen = picture_reader(STREET, background=True)(1, "left")
    luma = round(0.299 * RED[0] + 0.587 * RED[1] + 0.114 * RED[2])
    assert seen[25, 20].tolist() == [luma, GREY, 100]  # red is 100 brighter, green 80 and blue 70 darker
    assert seen[5, 5].tolist() == [GREY, GREY, 0]
    assert (picture_reader(STREET, background=False)(1, "left") == Street().plane(1, "left", "rgb")).all()


def test_differences_of_dark_and_bright_do_not_wrap() -> None:
    dark, bright = np.zeros((1, 1, 3), np.uint8), np.full((1, 1, 3), 255, np.uint8)
    assert compare_with_background(dark, bright)[0, 0].tolist() == [0, 255, 255]


def seen_by_camera(box: tuple[float, float, float, float], kind: str) -> Annotations:
    """Return the annotations of one actor with this visible box."""
    boxes = np.array([box])
    views = Views(boxes, boxes, np.array([500]), np.zeros(1), np.zeros(1))
    return replace(frame([("a", kind, 20.0, 0.0, 9)]).annotations, views={"left": views})


@pytest.mark.parametrize(
    ("kind", "box", "wanted", "ignored"),
    [
        ("car", (10.0, 10.0, 40.0, 30.0), 1, 0),
        ("van", (-0.5, 10.0, 40.0, 30.0), 1, 0),  # cut off by the picture's edge
        ("car", (10.0, 10.0, 18.0, 16.0), 0, 1),  # too small
        ("bus", (10.0, 10.0, 40.0, 30.0), 0, 0),
    ],
)
def test_cars_are_labelled_whole_or_not(kind, box, wanted, ignored) -> None:
    shown = replace(frame([]), annotations=seen_by_camera(box, kind))
    sample = label_picture(shown, "left", np.zeros((64, 96, 3), np.uint8), ROAD)
    assert (len(sample.boxes), len(sample.ignore)) == (wanted, ignored)
    if wanted:
        assert ROAD.classes[sample.label[0]] == kind
        assert sample.boxes[0].tolist() == [value + 0.5 for value in box]


def test_channels_are_not_mixed_by_augmentation() -> None:
    picture = np.zeros((192, 320, 3), np.uint8)
    picture[...] = (40, 80, 0)
    shown = replace(frame([]), annotations=seen_by_camera((100.0, 60.0, 140.0, 90.0), "car"))
    sample = label_picture(shown, "left", picture, ROAD)
    drawn = draw_mosaic([sample], 0, ROAD, np.random.default_rng(0)).picture
    assert {tuple(pixel) for pixel in drawn.reshape(-1, 3).tolist()} == {(40, 80, 0)}


def test_findings_in_a_dataset_are_of_pictures_beside_their_background(monkeypatch, tmp_path) -> None:
    (tmp_path / MANIFEST).touch()
    monkeypatch.setattr(Dataset, "open", lambda path: STREET)
    shown = []
    monkeypatch.setattr(
        predict, "detect_in_picture", lambda network, picture, threshold: shown.append(picture) or NOTHING
    )
    findings = list(detect_signs(SignDetector(ROAD), tmp_path, 0.5, [1, 3]))
    for number, finding, seen in zip((1, 3), findings, shown, strict=True):
        assert (finding.seen == Street().plane(number, "left", "rgb")).all()
        assert (seen == picture_reader(STREET, background=True)(number, "left")).all()
    assert findings[0].path == tmp_path / f"{STREET.frame(1).key}/left"
    assert findings[0].result.lines() == ["0 boxes"]


def test_cameras_that_move_are_refused(monkeypatch, tmp_path) -> None:
    moving = cast("Dataset", Street("cav0"))
    (tmp_path / MANIFEST).touch()
    monkeypatch.setattr(Dataset, "open", lambda path: moving)
    refused = (
        lambda: picture_reader(moving, background=True)(1, "left"),
        lambda: RecordedPictures(moving, ROAD),
        lambda: next(detect_signs(SignDetector(ROAD), tmp_path, 0.5)),
    )
    for call in refused:
        with pytest.raises(InputError, match=r"^street: cav0 moves, .*; choose them with --agents poles$"):
            call()
    assert (picture_reader(moving, background=False)(1, "left") == Street().plane(1, "left", "rgb")).all()


def test_what_it_cannot_do_is_refused() -> None:
    network = SignDetector(ROAD)
    with pytest.raises(InputError, match="a dataset is wanted"):
        next(detect_signs(network, Path("street"), 0.5))
    with pytest.raises(InputError, match="vehicles have none"):
        SIGNS.pack_samples(STREET, ROAD, [0])
    with pytest.raises(InputError, match="finds car, van"):
        SIGNS.register_errors(network, STREET)
