"""The export in CULane's layout: lists, lines and label images say the same, and it is refused without a map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import painted_source
import pytest
from painted_source import PaintedSource
from PIL import Image

from flcav.config import InputError
from flcav.dataset.formats.conversion import export
from flcav.dataset.formats.culane import LABELS, number_lines
from flcav.dataset.formats.writing import ExportOptions
from flcav.dataset.recording.recorder import record
from flcav.dataset.road_labels import label_road, road_marks
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, pose, transform_points
from flcav.sensors.frame import SEMANTICS, Frame
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.world.map.lanes import map_layers
from flcav.world.map.town import load_town


class OnTheRoad(PaintedSource):
    """The painted frames of the suburb, whose front camera stands in a street and sees nothing but level ground."""

    def frame(self, scene: str, index: int, agent: str) -> Frame:
        frame = super().frame(scene, index, agent)
        if not frame.images:
            return frame
        marking = max((one for one in map_layers(load_town("suburb")).markings if one.kind == "dashed"), key=_length)
        a, b = marking.line[:2]
        ahead = (b - a) / np.hypot(*(b - a))
        x, y = a + ahead + 1.5 * np.array([ahead[1], -ahead[0]])
        posed = replace(
            frame, world_from_agent=pose(x, y, yaw=float(np.arctan2(ahead[1], ahead[0]))), agent_at_trigger={}
        )
        image = posed.images["front"]
        rays = compute_pixel_rays(LENS).astype(np.float64) @ posed.world_from_sensor("front")[:3, :3].T
        with np.errstate(divide="ignore"):
            away = np.where(rays[:, 2] < 0, -posed.world_from_sensor("front")[2, 3] / rays[:, 2], np.inf)
        assert image.semantic is not None
        depth = (away * compute_pixel_rays(LENS)[:, 2]).reshape(image.semantic.shape).astype(np.float32)
        ground = np.where(np.isfinite(depth), SEMANTICS["road"], SEMANTICS["sky"]).astype(np.uint8)
        street = replace(image, depth_m=depth, semantic=ground)
        return replace(posed, images={**posed.images, "front": street})


LENS = Lens(width=painted_source.WIDTH, height=painted_source.HEIGHT, fx=painted_source.FOCAL)


def _length(marking):
    return float(np.hypot(*np.diff(marking.line, axis=0).T).sum())


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("street") / "dataset"
    record(OnTheRoad(3, spins=1, town="suburb"), folder)
    return Dataset.open(folder, checked=False)


@pytest.fixture(scope="module")
def written(street, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("culane") / "out"
    export(street, "culane", out, ExportOptions(validation=0.3))
    return out


def lines_of(path: Path) -> list[np.ndarray]:
    """Return the lines of a `.lines.txt` as points (K, 2), as CULane's evaluation reads them."""
    rows = [np.array(row.split(), float).reshape(-1, 2) for row in path.read_text().splitlines()]
    assert all(len(row) > 1 for row in rows)
    return rows


def test_lists_name_each_picture_with_the_lines_that_its_label_image_has(street, written):
    listed = {}
    for split in ("train", "val"):
        named = (written / "list" / f"{split}.txt").read_text().splitlines()
        rows = [row.split() for row in (written / "list" / f"{split}_gt.txt").read_text().splitlines()]
        assert [row[0] for row in rows] == named
        listed |= {row[0]: row[1:] for row in rows}
    assert len(listed) == sum(len(street.cameras(i)) for i in range(len(street))) == len([*written.rglob("*.jpg")])
    seen = 0
    for picture, (label, *there) in listed.items():
        image = np.asarray(Image.open(written / label.lstrip("/")))
        assert label.startswith(f"/{LABELS}/")
        assert image.shape == Image.open(written / picture.lstrip("/")).size[::-1]
        assert [int(number in image) for number in (1, 2, 3, 4)] == [int(word) for word in there]
        lines = lines_of((written / picture.lstrip("/")).with_suffix(".lines.txt"))
        assert len(lines) == sum(map(int, there))
        for number, line in zip([n for n in (1, 2, 3, 4) if n in image], lines, strict=True):
            u, v = line[1:-1].round().astype(int).T
            assert (image[v, u] == number).all()
            assert (np.diff(line[:, 1]) == -10).all()
            seen += 1
    assert seen >= 3


def test_lines_are_the_map_s_seen_by_the_camera(street, written):
    """Every point of a line, sent back to the ground, lies on a marking of the town."""
    lines = [one for one in map_layers(load_town("suburb")).markings if one.kind in ("solid", "dashed", "edge")]
    painted = np.concatenate([np.linspace(a, b, 200) for one in lines for a, b in zip(one.line, one.line[1:])])
    for i in range(len(street)):
        frame = street.frame(i)
        if "front" not in frame.images:
            continue
        world = frame.world_from_sensor("front")
        for line in lines_of(written / frame.scene / f"{frame.key}_front.lines.txt"):
            rays = np.column_stack((line, np.ones(len(line)))) @ np.linalg.inv(LENS.intrinsics()).T @ world[:3, :3].T
            places = world[:3, 3] - rays * (world[2, 3] / rays[:, 2])[:, None]
            off = [np.hypot(*(painted - place[:2]).T).min() for place in places]
            assert max(off) < 0.25
        assert np.allclose(transform_points(inverse(world), world[None, :3, 3]), 0)


class Hidden(OnTheRoad):
    """The same street, in whose pictures something stands in front of the left half."""

    def frame(self, scene: str, index: int, agent: str) -> Frame:
        frame = super().frame(scene, index, agent)
        if not frame.images:
            return frame
        image = frame.images["front"]
        assert image.semantic is not None
        assert image.depth_m is not None
        semantic, depth = image.semantic.copy(), image.depth_m.copy()
        semantic[:, : LENS.width // 2], depth[:, : LENS.width // 2] = SEMANTICS["car"], 3.0
        return replace(frame, images={**frame.images, "front": replace(image, semantic=semantic, depth_m=depth)})


def test_what_is_hidden_has_no_label_and_what_shows_keeps_its(street, tmp_path):
    record(Hidden(1, spins=1, town="suburb"), tmp_path / "hidden")
    hidden, half = Dataset.open(tmp_path / "hidden", checked=False), LENS.width // 2
    free, cut = (label_road(data, 0, "front") for data in (street, hidden))
    assert (free.classes[:, :half] > 0).any()
    assert not cut.classes[:, :half].any()
    inner = half + 4  # a line that begins in the hidden half ends with its last visible point
    assert (cut.classes[:, inner:] == free.classes[:, inner:]).mean() > 0.995
    assert len(cut.lines) < len(free.lines)
    assert all((line.pixels[:, 0] > half - 1).all() for line in cut.lines)


def test_a_kind_of_marking_without_a_class_is_one_sentence():
    layers = map_layers(load_town("suburb"))
    strange = replace(layers.markings[0], kind="botts_dots")
    with pytest.raises(
        InputError, match="a map with markings 'botts_dots', which have no class; known are solid, edge"
    ):
        road_marks(replace(layers, markings=(strange,)))


def test_numbers_are_by_side_and_nearness():
    def line(foot):
        return np.array([[foot, 383.0], [320 + (foot - 320) / 4, 220.0]])

    numbered = number_lines([line(500.0), line(200.0), line(50.0), line(600.0), line(-90.0), line(700.0)], 640, 384)
    assert {number: float(found[0, 0]) for number, found in numbered.items()} == {1: 50, 2: 200, 3: 500, 4: 600}


def test_equal_exports_are_equal_bytes_and_a_test_goes_to_its_own_lists(street, written, tmp_path):
    export(street, "culane", tmp_path / "again", ExportOptions(validation=0.3))
    files = [path.relative_to(written) for path in written.rglob("*") if path.is_file()]
    assert all((tmp_path / "again" / path).read_bytes() == (written / path).read_bytes() for path in files)
    record(OnTheRoad(1, spins=1, split="test", town="suburb"), tmp_path / "test")
    export(Dataset.open(tmp_path / "test", checked=False), "culane", tmp_path / "out")
    names = sorted(
        path.relative_to(tmp_path / "out" / "list").as_posix() for path in (tmp_path / "out" / "list").rglob("*.txt")
    )
    assert names == ["test.txt", "test_gt.txt", "test_split/test0_normal.txt"]


def test_further_lines_are_counted_and_a_dataset_without_a_map_is_refused(street, tmp_path):
    done = export(street, "culane", tmp_path / "out", ExportOptions(validation=0))
    every = sum(len(label_road(street, i, camera).lines) for i in range(len(street)) for camera in street.cameras(i))
    left = sum(number for each, number in done.left_out.items() if each.what == "lane lines")
    assert done.counts["lane lines"] + left == every > 0
    record(PaintedSource(2), tmp_path / "painted")
    with pytest.raises(InputError, match="painted: without a map of its town, which labels of the road come from"):
        export(Dataset.open(tmp_path / "painted"), "culane", tmp_path / "none")
    assert not (tmp_path / "none").exists()
