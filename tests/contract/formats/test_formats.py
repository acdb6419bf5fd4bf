"""Every format holds what the dataset holds: read back by `format_readers`, and by COCO's own readers."""

import csv
import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import painted_source
import pytest
import shapely
import yaml
from format_readers import READERS, Seen, mcap_topics, nuscenes_points
from google.protobuf.message import Message
from painted_source import CATEGORIES, ECHOES, IN_BOX, PaintedSource
from PIL import Image
from shapely.geometry import MultiPoint

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.formats.conversion import export, import_dataset
from flcav.dataset.formats.formats import EXPORTS, export_format
from flcav.dataset.formats.writing import ExportOptions
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, points_in_boxes, wrap_angle
from flcav.sensors.frame import Frame

SCENES = 3  # of which the last validates
PAINTED = [name for name in EXPORTS if name != "culane"]  # which needs the map of a town: test_culane.py
BRUSH_PX = 1.5  # pillow paints so far beyond the edges of a polygon
KITTI = ["Car", "Van", "Truck", "Truck", "Cyclist", "Cyclist", "Pedestrian", "Car", "Car"]
NUSCENES = ["car", "car", "truck", "bus.rigid", "motorcycle", "bicycle"]
NAMES = {
    "kitti": KITTI,
    "nuscenes": [f"vehicle.{name}" for name in NUSCENES] + ["human.pedestrian.adult", "vehicle.car", "vehicle.car"],
    "opv2v": ["vehicle"] * len(CATEGORIES),
    "mcap": CATEGORIES,
}
PRECISION = {"kitti": 1e-4, "nuscenes": 1e-6, "opv2v": 1e-6, "mcap": 1e-6}  # metres, radians
INTENSITY = {"kitti": 0, "nuscenes": 1e-6, "opv2v": 0.5 / 255 + 1e-6, "mcap": 0}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("painted") / "dataset"
    record(PaintedSource(SCENES), folder)
    return Dataset.open(folder)


def _options(name: str) -> ExportOptions:
    return ExportOptions(validation=0.3) if "validation" in export_format(name).options else ExportOptions()


@pytest.fixture(scope="module")
def exported(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("exports")
    for name in PAINTED:
        export(dataset, name, root / name, _options(name))
    export(dataset, "yolo", root / "yolo_actors", ExportOptions(validation=0.3, labels="actors"))
    return {path.name: path for path in root.iterdir()}


@pytest.fixture(scope="module")
def seen(exported: dict[str, Path]) -> dict[str, dict[str, Seen]]:
    return {name: read(exported[name]) for name, read in READERS.items()}


def _kept(name: str, frame: Frame) -> np.ndarray:
    """Return which actors of a frame the format is meant to hold."""
    if name == "kitti":
        views = frame.annotations.views["front"]
        left, top, right, bottom = np.nan_to_num(views.amodal_box, nan=-1).T
        within = (right > 0) & (bottom > 0) & (left < painted_source.WIDTH - 1) & (top < painted_source.HEIGHT - 1)
        return np.flatnonzero(within & (IN_BOX > 0))
    if name == "opv2v":
        return np.flatnonzero(np.isin(CATEGORIES, ["car", "van", "truck", "bus"]) & (IN_BOX > 0))
    return np.arange(len(CATEGORIES))


@pytest.mark.parametrize("name", READERS)
def test_boxes_names_and_counts_are_the_source_s(name: str, dataset: Dataset, seen: dict[str, dict[str, Seen]]):
    expected = {
        key: frame
        for frame in (dataset.frame(i) for i in range(len(dataset)))
        if frame.images or name != "kitti"
        for key in [frame.key]
    }
    assert seen[name].keys() == expected.keys()
    for key, frame in expected.items():
        kept, boxes = _kept(name, frame), seen[name][key].boxes
        source = frame.annotations.boxes.transform(inverse(frame.world_from_sensor("lidar")))[kept]
        assert sorted(boxes.label.tolist()) == sorted(NAMES[name][i] for i in kept)
        away = np.abs(boxes.center[:, None] - source.center[None]).max(axis=2)
        match = away.argmin(axis=1)
        assert sorted(match) == list(range(len(kept)))
        assert boxes.label.tolist() == [NAMES[name][kept[i]] for i in match]
        assert away.min(axis=1).max() <= PRECISION[name]
        assert np.abs(boxes.size - source.size[match]).max() <= PRECISION[name]
        assert np.abs(wrap_angle(boxes.yaw - source.yaw[match])).max() <= PRECISION[name]


@pytest.mark.parametrize("name", READERS)
def test_points_are_the_source_s_and_lie_in_their_boxes(name: str, dataset: Dataset, seen: dict[str, dict[str, Seen]]):
    for key, frame in seen[name].items():
        source = dataset.frame(dataset.number(key))
        cloud = source.lidar["lidar"]
        np.testing.assert_allclose(frame.points[:, :3], cloud[:, :3], atol=1e-5)
        np.testing.assert_allclose(frame.points[:, 3], cloud[:, 3], atol=max(INTENSITY[name], 1e-9))
        truth = source.annotations.boxes.transform(inverse(source.world_from_sensor("lidar")))
        rows = np.linalg.norm(frame.boxes.center[:, None] - truth.center[None], axis=2).argmin(axis=1)
        inside = points_in_boxes(frame.points, frame.boxes, 1e-3).sum(axis=1)
        np.testing.assert_array_equal(inside, IN_BOX[rows])


@pytest.mark.parametrize("name", READERS)
def test_boxes_project_onto_their_pixels(name: str, dataset: Dataset, seen: dict[str, dict[str, Seen]]):
    """Painted pixels lie within the projected hull of their actor's box, and where all of it shows they fill it."""
    painted, expected = 0, 0
    for key, frame in seen[name].items():
        source = dataset.frame(dataset.number(key))
        truth = source.annotations.boxes.transform(inverse(source.world_from_sensor("lidar")))
        rows = np.linalg.norm(frame.boxes.center[:, None] - truth.center[None], axis=2).argmin(axis=1)
        cameras = [camera for camera in source.images if camera == "front" or name != "kitti"]
        assert len(frame.images) == len(cameras)
        expected += sum((source.annotations.views[camera].pixels[rows] > 0).sum() for camera in cameras)
        for image, projection in frame.images:
            for row, corners in zip(rows, frame.boxes.corners()):
                v, u = np.nonzero((image == painted_source.colour(row)).all(axis=2))
                if not len(u):
                    continue
                projected = np.column_stack((corners, np.ones(8))) @ projection.T
                assert (projected[:, 2] > 0).all()
                hull = MultiPoint(projected[:, :2] / projected[:, 2:]).convex_hull
                assert (shapely.distance(hull, shapely.points(u, v)) < BRUSH_PX).all()
                views = next(view for view in source.annotations.views.values() if view.pixels[row])
                if views.occlusion[row] + views.truncation[row] == 0:
                    assert len(u) > 0.9 * hull.area
                painted += 1
    assert painted == expected > 0


def test_kitti_splits_by_scene_and_has_what_openpcdet_expects(dataset: Dataset, exported: dict[str, Path]):
    out = exported["kitti"]
    lists = {name: (out / "ImageSets" / f"{name}.txt").read_text().split() for name in ("train", "val", "test")}
    with (out / "frames.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    scenes = {split: {row["frame"][:13] for row in rows if row["number"] in lists[split]} for split in lists}
    assert scenes == {"train": {"painted-0-000", "painted-0-001"}, "val": {"painted-0-002"}, "test": set()}
    trainval = (out / "ImageSets" / "trainval.txt").read_text().split()
    assert sorted(lists["train"] + lists["val"]) == trainval == [row["number"] for row in rows]
    lines = (out / "training" / "calib" / "000000.txt").read_text().splitlines()
    assert [line.split(":")[0] for line in lines] == [f"P{i}" for i in range(4)] + [
        "R0_rect",
        "Tr_velo_to_cam",
        "Tr_imu_to_velo",
    ]
    shapes = [len(line.split()) - 1 for line in lines]
    assert shapes == [12, 12, 12, 12, 9, 12, 12]
    for line in (out / "training" / "label_2" / "000000.txt").read_text().splitlines():
        name, *fields = line.split(" ")
        if name == "DontCare":
            continue
        assert name in {"Car", "Van", "Truck", "Cyclist", "Pedestrian"}
        assert len(fields) == 14
        truncation, occlusion, alpha, left, _, right, _, *_, x, _, z, rotation = map(float, fields)
        assert 0 <= truncation <= 1
        assert occlusion in (0, 1, 2, 3)
        assert wrap_angle(rotation - np.arctan2(x, z) - alpha) == pytest.approx(0, abs=1e-3)
        assert 0 <= left < right <= painted_source.WIDTH - 1


def test_kitti_s_imu_stands_where_it_is_mounted(dataset: Dataset, exported: dict[str, Path]):
    mounts = dataset.frame(0).calibration.agent_from_sensor
    line = (exported["kitti"] / "training" / "calib" / "000000.txt").read_text().splitlines()[-1]
    lidar_from_imu = np.vstack((np.array(line.split()[1:], np.float64).reshape(3, 4), (0, 0, 0, 1)))
    np.testing.assert_allclose(mounts["lidar"] @ lidar_from_imu, mounts["imu"], atol=1e-6)
    assert not np.allclose(mounts["lidar"], mounts["imu"], atol=0.1)


def test_kitti_grades_occlusion(dataset: Dataset, seen: dict[str, dict[str, Seen]], exported: dict[str, Path]):
    """The second car stands behind the first; what shows no pixel is of unknown occlusion."""
    from flcav.dataset.formats.kitti import KittiFolder

    objects = KittiFolder.open(exported["kitti"]).frame(0).objects
    views = dataset.frame(0).annotations.views["front"]
    row = {tuple(np.round(size, 2)): i for i, size in enumerate(dataset.frame(0).annotations.boxes.size.tolist())}
    for size, level, rectangle in zip(objects.boxes.size, objects.occlusion, objects.rectangle):
        i = row[tuple(np.round(size, 2).tolist())]
        hidden = views.occlusion[i]
        assert level == (3 if not views.pixels[i] else 0 if hidden < 0.1 else 1 if hidden < 0.5 else 2)
        wide, tall = painted_source.WIDTH - 1, painted_source.HEIGHT - 1
        np.testing.assert_allclose(rectangle, np.clip(views.amodal_box[i], 0, (wide, tall, wide, tall)), atol=1e-4)
    assert len(set(objects.occlusion.tolist())) > 1


def test_kitti_marks_what_shows_without_a_point_as_not_labelled(
    dataset: Dataset, exported: dict[str, Path], tmp_path: Path
):
    """The truck ahead shows and no point of the LiDAR lies in its box; asked for, it is labelled all the same."""
    truck = CATEGORIES.index("truck")
    box = dataset.frame(0).annotations.views["front"].visible_box[truck]
    lines = (exported["kitti"] / "training" / "label_2" / "000000.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines].index("DontCare") == len(lines) - 1, "OpenPCDet counts on it to be last"
    kind, *fields = lines[-1].split()
    assert (kind, fields[:3], fields[7:]) == ("DontCare", ["-1", "-1", "-10"], ["-1"] * 3 + ["-1000"] * 3 + ["-10"])
    np.testing.assert_allclose([float(field) for field in fields[3:7]], np.clip(box, 0, None), atol=1e-4)
    exported_all = export(dataset, "kitti", tmp_path / "all", ExportOptions(min_points=0))
    assert exported_all.counts["DontCare_regions"] == 0
    more = (tmp_path / "all" / "training" / "label_2" / "000000.txt").read_text().splitlines()
    assert len(more) == len(lines)
    assert sum(line.startswith("Truck") for line in more) == 1 + sum(line.startswith("Truck") for line in lines)
    few = export(dataset, "kitti", tmp_path / "few", ExportOptions(min_points=41))
    assert few.counts["objects"] == 2 * few.counts["frames"]  # the car and the van ahead; the bus is behind


def test_kitti_has_a_line_for_a_frame_without_labels(tmp_path: Path):
    record(PaintedSource(1, spins=1, deserted=True), tmp_path / "dataset")
    export(Dataset.open(tmp_path / "dataset"), "kitti", tmp_path / "out")
    line = (tmp_path / "out" / "training" / "label_2" / "000000.txt").read_text()
    assert line == "DontCare -1 -1 -10 0 0 1 1 -1 -1 -1 -1000 -1000 -1000 -10\n"
    assert len(READERS["kitti"](tmp_path / "out")["painted-0-000_0000_cav0"].boxes) == 0


def test_nuscenes_counts_the_points_in_the_boxes(exported: dict[str, Path]):
    """Not those of the actor, of which the source has more, or another number."""
    by_radar = 0
    for said, inside in nuscenes_points(exported["nuscenes"]):
        assert said == inside
        lidar, radar = np.transpose(said)
        np.testing.assert_array_equal(lidar, IN_BOX)
        by_radar += all(radar[row] >= count for row, count in ECHOES.items())
    assert by_radar == SCENES * 2  # the pole has none


def _labels(found: dict[str, list], frame: Frame, camera: str, name: str) -> None:
    """Check (class name, left, top, right, bottom) rows of a picture, in pixels from its corner, against the source."""
    rows = sorted(found[f"{frame.key}_{camera}"])
    if name == "signs":
        signs = frame.annotations.signs[camera]
        expected = [("stop", 0), ("speed_60", 1), ("light_red", 2), ("light_green", 3)]
        source = [(label, *(signs.box[i] + 0.5)) for label, i in expected]
    else:
        views = frame.annotations.views[camera]
        source = [(CATEGORIES[i], *(views.visible_box[i] + 0.5)) for i in np.flatnonzero(views.pixels)]
    assert [row[0] for row in rows] == [row[0] for row in sorted(source)]
    np.testing.assert_allclose([row[1:] for row in rows], [row[1:] for row in sorted(source)], atol=1e-3)


def _pictures(dataset: Dataset) -> list[tuple[Frame, str]]:
    return [(frame, camera) for i in range(len(dataset)) for frame in [dataset.frame(i)] for camera in frame.images]


@pytest.mark.parametrize(("folder", "name"), [("yolo", "signs"), ("yolo_actors", "actors")])
def test_yolo_labels_are_the_source_s(folder: str, name: str, dataset: Dataset, exported: dict[str, Path]):
    out = exported[folder]
    about = yaml.safe_load((out / "data.yaml").read_text())
    assert [about[split] for split in ("train", "val")] == ["images/train", "images/val"]
    found = {}
    for path in sorted(out.glob("images/*/*.png")):
        with Image.open(path) as image:
            wide, tall = image.size
        rows = []
        for line in (out / "labels" / path.parent.name / f"{path.stem}.txt").read_text().splitlines():
            number, x, y, w, h = map(float, line.split())
            assert all(0 <= value <= 1 for value in (x, y, w, h))
            left, top = (x - w / 2) * wide, (y - h / 2) * tall
            rows.append((about["names"][int(number)], left, top, left + w * wide, top + h * tall))
        found[path.stem] = rows
    pictures = _pictures(dataset)
    assert len(found) == len(pictures)
    for frame, camera in pictures:
        _labels(found, frame, camera, name)


@pytest.mark.parametrize("reader", ["pycocotools.coco", "faster_coco_eval"])
@pytest.mark.parametrize("name", ["signs", "actors"])
def test_coco_s_readers_find_the_source_s_labels_and_masks(
    reader: str, name: str, dataset: Dataset, exported: dict[str, Path], capsys: pytest.CaptureFixture[str]
):
    coco_class = pytest.importorskip(reader).COCO
    checked = 0
    for split in ("train", "val"):
        coco = coco_class(str(exported["coco"] / "annotations" / f"{name}_{split}.json"))
        found, number = {}, {}
        for image in coco.loadImgs(coco.getImgIds()):
            path = exported["coco"] / "images" / split / image["file_name"]
            pixels = np.asarray(Image.open(path))
            assert pixels.shape[:2] == (image["height"], image["width"])
            notes = coco.loadAnns(coco.getAnnIds(imgIds=[image["id"]]))
            rows = []
            for note in notes:
                x, y, w, h = note["bbox"]
                rows.append((coco.loadCats([note["category_id"]])[0]["name"], x, y, x + w, y + h))
                mask = coco.annToMask(note).astype(bool)
                assert mask.sum() == note["area"]
                if name == "signs":
                    v, u = np.nonzero(mask)
                    assert [u.min(), v.min(), u.max() + 1, v.max() + 1] == [x, y, x + w, y + h]
                if name == "actors":
                    painted = (pixels == painted_source.colour(int(note["track"][3:]))).all(axis=2)
                    np.testing.assert_array_equal(mask, painted)
                    checked += 1
            found[path.stem] = rows
            number[path.stem] = image["id"]
        scenes = {"train": ("000", "001"), "val": ("002",)}[split]
        for frame, camera in _pictures(dataset):
            if frame.scene[-3:] in scenes:
                _labels(found, frame, camera, name)
                del number[f"{frame.key}_{camera}"]
        assert not number
    assert checked or name == "signs"


def test_small_things_can_be_left_out(dataset: Dataset, tmp_path: Path):
    export(dataset, "coco", tmp_path / "out", ExportOptions(min_pixels=6))
    notes = json.loads((tmp_path / "out" / "annotations" / "signs_train.json").read_text())["annotations"]
    assert {note["area"] for note in notes} == {9, 6}


def test_mcap_holds_every_modality(dataset: Dataset, exported: dict[str, Path]):
    topics = mcap_topics(exported["mcap"] / "painted-0-000.mcap")
    frame = dataset.frame(0)
    clouds = topics["/cav0/radar/points"]
    assert len(clouds) == 2
    assert [field.name for field in clouds[0].fields][3:] == [
        "range_m",
        "azimuth_rad",
        "elevation_rad",
        "doppler_m_s",
        "rcs_dbsm",
    ]
    rows = np.frombuffer(clouds[0].data, "<f4").reshape(-1, 8)
    np.testing.assert_array_equal(rows[:, 3:], frame.radar["radar"])
    np.testing.assert_allclose(np.linalg.norm(rows[:, :3], axis=1), rows[:, 3], rtol=1e-5)
    fix = topics["/cav0/gnss/fix"][0]
    assert [fix.latitude, fix.longitude, fix.altitude] == frame.gnss["gnss"].tolist()
    imu = topics["/cav0/imu/imu"][0]
    halves = (imu["linear_acceleration"], imu["angular_velocity"])
    assert [half[axis] for half in halves for axis in "xyz"] == frame.imu["imu"].tolist()
    thermal = topics["/cav0/thermal/image"][0]
    assert thermal.encoding == "mono16"
    pixels = np.frombuffer(thermal.data, "<u2").reshape(thermal.height, thermal.step // 2)
    np.testing.assert_array_equal(pixels, frame.infrared["thermal"])
    assert topics["/cav0/weather"][0]["rain_mm_h"] == 3.0
    loops = topics["/cav0/front/labels"][0].points
    found = {}
    for loop in loops:
        about = {item.key: item.value for item in loop.metadata}
        xy = [(point.x, point.y) for point in loop.points]
        found[about.get("track", about["class"] + about.get("state", ""))] = (*min(xy), *max(xy))
    views, signs = frame.annotations.views["front"], frame.annotations.signs["front"]
    expected = {f"veh{i}": views.visible_box[i] for i in np.flatnonzero(views.pixels)}
    expected |= {f"{kind}{state}": box for kind, state, box in zip(signs.kind, signs.state, signs.box)}
    assert found.keys() == expected.keys()
    for name, box in expected.items():
        np.testing.assert_allclose(found[name], box + 0.5)


def test_every_time_stamp_of_an_mcap_is_set(exported: dict[str, Path]):
    """Foxglove shows a message without one at no time at all."""
    stamped = Counter()

    def check(message: Message, path: str) -> None:
        for field in message.DESCRIPTOR.fields:
            if field.message_type is not None and field.message_type.full_name == "google.protobuf.Timestamp":
                assert message.HasField(field.name), f"{path}.{field.name}"
                stamped[message.DESCRIPTOR.name] += 1
            elif field.message_type is not None:
                value = getattr(message, field.name)
                for part in value if field.is_repeated else [value]:
                    check(part, f"{path}.{field.name}")

    for topic, messages in mcap_topics(exported["mcap"] / "painted-0-000.mcap").items():
        for message in messages:
            if isinstance(message, Message):
                check(message, topic)
    assert stamped["ImageAnnotations"] == 2 * 3  # spins, cameras


@pytest.mark.parametrize("name", READERS)
def test_the_assumed_calibration_moves_the_sensors_only(name: str, dataset: Dataset, tmp_path: Path):
    """The source assumes the LiDAR 0.1 m too far ahead, so that boxes come 0.1 m too near to it."""
    export(dataset, name, tmp_path / "true")
    export(dataset, name, tmp_path / "assumed", ExportOptions(calibration="assumed"))
    true, assumed = (READERS[name](tmp_path / which) for which in ("true", "assumed"))
    for key, frame in true.items():
        away = frame.boxes.center - assumed[key].boxes.center
        np.testing.assert_array_equal(frame.points, assumed[key].points)
        if key.endswith("cav0"):
            np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.1, atol=2e-4)


@pytest.mark.parametrize("name", PAINTED)
def test_an_export_that_ends_early_leaves_nothing(name: str, dataset: Dataset, tmp_path: Path):
    def full_disk(done: int, total: int, note: str) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left") as error:
        export(dataset, name, tmp_path / "out", progress=full_disk)
    assert error.value.filename == str(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".out.part").mkdir()
    (tmp_path / ".out.part" / "left").touch()
    (tmp_path / "out").mkdir()
    export(dataset, name, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("left"))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("name", PAINTED)
def test_progress_reaches_the_end(name: str, dataset: Dataset, tmp_path: Path):
    calls = []
    export(dataset, name, tmp_path / "out", progress=lambda done, total, note: calls.append((done, total)))
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)
    assert calls[-1] == (len(dataset), len(dataset))


@pytest.mark.parametrize("name", PAINTED)
def test_equal_exports_are_equal_bytes(name: str, dataset: Dataset, exported: dict[str, Path], tmp_path: Path):
    export(dataset, name, tmp_path / "out", _options(name))
    files = {path.relative_to(tmp_path / "out"): path for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert len(files) == len([path for path in exported[name].rglob("*") if path.is_file()])
    for relative, path in files.items():
        assert path.read_bytes() == (exported[name] / relative).read_bytes(), relative


def test_targets_that_are_refused(dataset: Dataset, tmp_path: Path):
    with pytest.raises(InputError, match="export format 'waymo': choose one of kitti, yolo, coco"):
        export(dataset, "waymo", tmp_path / "out")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file"):
        export(dataset, "kitti", tmp_path / "file")
    with pytest.raises(InputError, match="holds other files"):
        export(dataset, "kitti", tmp_path)


@pytest.mark.parametrize(
    ("name", "source", "needed"),
    [
        ("kitti", PaintedSource(2, cameras=False), "a level camera that looks ahead; the dataset has none"),
        ("yolo", PaintedSource(2, cameras=False), "camera images"),
        ("coco", PaintedSource(2, cameras=False), "camera images"),
        ("kitti", PaintedSource(2, lidar=False), "a LiDAR and"),
        ("nuscenes", PaintedSource(2, lidar=False), "a LiDAR on every agent; cav0 has none"),
        ("opv2v", PaintedSource(2, lidar=False), "a LiDAR on every agent; cav0 has none"),
    ],
)
def test_what_a_dataset_lacks_is_one_sentence(name: str, source: PaintedSource, needed: str, tmp_path: Path):
    record(source, tmp_path / "dataset")
    dataset = Dataset.open(tmp_path / "dataset")
    with pytest.raises(InputError, match=f"dataset: cannot be exported to .* needs .*{needed}"):
        export(dataset, name, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("split", "lists"), [("val", ["val"]), ("test", ["test"]), ("extra", ["train", "val"])])
def test_a_dataset_goes_to_the_split_it_was_recorded_for(split: str, lists: list[str], tmp_path: Path):
    record(PaintedSource(2, spins=1, split=split), tmp_path / "dataset")
    export(Dataset.open(tmp_path / "dataset"), "opv2v", tmp_path / "out")
    folders = {"train": "train", "val": "validate", "test": "test"}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(folders[name] for name in lists)


@pytest.mark.parametrize("name", ["yolo", "opv2v"])
def test_one_scene_cannot_train_and_validate(name: str, tmp_path: Path):
    """Ultralytics refuses a data.yaml without `val`, OpenCOOD finds no folder; an empty one has to be asked for."""
    record(PaintedSource(1, spins=1), tmp_path / "dataset")
    dataset = Dataset.open(tmp_path / "dataset")
    with pytest.raises(InputError, match=r"needs scenes that validate .* record two or more"):
        export(dataset, name, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    export(dataset, name, tmp_path / "out", ExportOptions(validation=0))
    assert not list((tmp_path / "out" / {"yolo": "images/val", "opv2v": "validate"}[name]).iterdir())


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_a_data_yaml_names_folders_to_train_and_to_validate(split: str, tmp_path: Path):
    record(PaintedSource(2, spins=1, split=split), tmp_path / "dataset")
    export(Dataset.open(tmp_path / "dataset"), "yolo", tmp_path / "out")
    about = yaml.safe_load((tmp_path / "out" / "data.yaml").read_text())
    assert [name for name in about if name != "names"] == ["train", "val", *(["test"] if split == "test" else [])]
    pictures = {name: len(list((tmp_path / "out" / about[name]).iterdir())) for name in about if name != "names"}
    assert pictures[split] == (2 if split == "train" else 4)


@pytest.mark.parametrize("name", [name for name in EXPORTS if "validation" in export_format(name).options])
def test_a_share_to_validate_is_refused_of_a_dataset_recorded_for_it(name: str, tmp_path: Path):
    record(PaintedSource(2, spins=1, split="test"), tmp_path / "dataset")
    with pytest.raises(InputError, match="its recipe says 'split: test', so --validation is not for it"):
        export(Dataset.open(tmp_path / "dataset"), name, tmp_path / "out", ExportOptions(validation=0.2))


def _summary(name: str, dataset: Path, out: Path, capsys: pytest.CaptureFixture[str], *asked: str) -> list[str]:
    with pytest.raises(SystemExit) as end:
        run(["export", name, str(dataset), "--out", str(out), *asked])
    assert not end.value.code
    return capsys.readouterr().out.splitlines()


def test_opv2v_holds_the_spins_that_every_agent_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """OpenCOOD takes the spins of the first agent and looks for them at all others."""
    record(PaintedSource(2, spins=3, cut=1), tmp_path / "dataset")
    written, classes, points, sensors, left_out = _summary("opv2v", tmp_path / "dataset", tmp_path / "out", capsys)
    assert "exported 2 scenarios, 8 frames, 32 objects, " in written
    assert classes == "left out 24 objects: OPV2V has no class for them (motorcycle, bicycle, pedestrian)"
    assert points == "left out 16 objects: fewer than 1 LiDAR point in the box (--min-points)"
    assert sensors == "left out 16 measurements: OPV2V has no place for them (thermal, radar, gnss, imu)"
    spins = "spin 2 of painted-0-000, spin 2 of painted-0-001"
    assert left_out == f"left out 2 frames, 18 objects: OPV2V needs each spin of every agent ({spins})"
    seen = READERS["opv2v"](tmp_path / "out")
    assert sorted({key[14:18] for key in seen}) == ["0000", "0001"]
    assert len(seen) == 8


def test_kitti_says_which_frames_it_leaves_out(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    written, outside, points, sensors, left_out = _summary("kitti", dataset.folder, tmp_path / "out", capsys)
    assert f"exported {2 * SCENES} frames, 30 objects, 6 DontCare regions, " in written
    assert outside == "left out 18 objects: outside the image"
    assert points == "left out 6 objects: fewer than 1 LiDAR point in the box (--min-points)"
    assert sensors == "left out 30 measurements: KITTI has no place for them (back, thermal, radar, gnss, imu)"
    assert left_out == f"left out {2 * SCENES} frames, 54 objects: no level camera that looks ahead (pole3)"


@pytest.mark.parametrize("labels", [None, "actors"])
def test_yolo_says_that_it_labels_signs_or_actors(
    labels: str | None, dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    asked = ["--labels", labels] if labels else []
    written, *left_out = _summary("yolo", dataset.folder, tmp_path / "out", capsys, *asked)
    if labels is None:
        assert "exported 12 images, 48 signs, " in written
        assert left_out == [
            "left out 12 signs: there is no class for them (signal off)",
            "left out 42 actors: YOLO has one list of classes, by default signs and lights; "
            "--labels actors writes vehicles and pedestrians",
            "left out 36 measurements: YOLO has no place for them (lidar, thermal, radar, gnss, imu)",
        ]
    else:
        assert "exported 12 images, 42 actors, " in written
        assert left_out == [
            "left out 60 signs: --labels actors writes vehicles and pedestrians alone; signs are the default",
            "left out 36 measurements: YOLO has no place for them (lidar, thermal, radar, gnss, imu)",
        ]


def _count_objects(name: str, out: Path) -> int:
    """Return the number of labelled objects in the files of an export."""
    if name == "yolo":
        return sum(len(path.read_text().splitlines()) for path in (out / "labels").rglob("*.txt"))
    if name == "coco":
        return sum(len(json.loads(path.read_text())["annotations"]) for path in (out / "annotations").iterdir())
    return sum(len(frame.boxes) for frame in READERS[name](out).values())


@pytest.mark.parametrize("options", [{}, {"min_points": 20, "min_pixels": 6, "labels": "actors"}])
@pytest.mark.parametrize("name", PAINTED)
def test_every_object_is_written_or_left_out_for_a_reason(name: str, options: dict[str, object], tmp_path: Path):
    record(PaintedSource(2, spins=3, cut=1), tmp_path / "dataset")
    dataset = Dataset.open(tmp_path / "dataset")
    frames = [dataset.frame(i) for i in range(len(dataset))]
    if name in ("yolo", "coco"):
        images = [(frame.annotations, camera) for frame in frames for camera in frame.images]
        source = sum((truth.views[camera].pixels > 0).sum() + len(truth.signs[camera]) for truth, camera in images)
    else:
        source = sum(len(frame.annotations) for frame in frames)
    taken = {option: value for option, value in options.items() if option in export_format(name).options}
    exported = export(dataset, name, tmp_path / "out", ExportOptions.model_validate(taken))
    left_out = Counter[str]()
    for each, number in exported.left_out.items():
        assert each.why
        left_out[each.what] += number
    kinds = ("objects", "signs", "actors")
    written = _count_objects(name, tmp_path / "out")
    assert written == sum(exported.counts[kind] for kind in kinds) > 0
    assert written + sum(left_out[kind] for kind in kinds) == source
    if "frames" in exported.counts:
        assert exported.counts["frames"] + left_out["frames"] == len(dataset)


@pytest.mark.parametrize(("name", "lacks"), [("kitti", False), ("nuscenes", True), ("opv2v", True), ("mcap", False)])
def test_a_class_that_a_format_lacks_is_named(name: str, lacks: bool, exported: dict[str, Path], tmp_path: Path):
    """Trams are of KITTI's classes; an import keeps their name."""
    shutil.copytree(exported["kitti"], tmp_path / "kitti")
    trams = 0
    for path in (tmp_path / "kitti" / "training" / "label_2").iterdir():
        text = path.read_text()
        trams += text.count("Van")
        path.write_text(text.replace("Van", "Tram"))
    import_dataset("kitti", tmp_path / "kitti", tmp_path / "dataset")
    dataset = Dataset.open(tmp_path / "dataset")
    written = export(dataset, name, tmp_path / "out")
    left_out = {each.which: number for each, number in written.left_out.items() if "no class" in each.why}
    assert left_out.get("Tram", 0) == trams * lacks
    objects = sum(number for each, number in written.left_out.items() if each.what == "objects")
    assert written.counts["objects"] + objects == sum(len(dataset.frame(i).annotations) for i in range(len(dataset)))
    assert trams > 0


@pytest.mark.parametrize("name", [name for name in PAINTED if name != "mcap"])  # which holds all: see above
def test_every_measurement_is_a_file_or_left_out(name: str, dataset: Dataset, tmp_path: Path):
    left_out = export(dataset, name, tmp_path / "out").left_out
    frames = [dataset.frame(i) for i in range(len(dataset))]
    kept = [frame for frame in frames if frame.images or name != "kitti"]
    kinds = ("lidar", "images", "infrared", "radar", "gnss", "imu")
    files = [path for path in (tmp_path / "out").rglob("*") if path.suffix in (".png", ".bin", ".pcd")]
    written = sum(path.parent.name != "maps" for path in files)
    others = sum(number for each, number in left_out.items() if each.what == "measurements")
    assert written + others == sum(len(getattr(frame, kind)) for frame in kept for kind in kinds)


VALUES = {"labels": "actors", "validation": 0.5, "min_pixels": 6, "min_points": 50, "calibration": "assumed"}


@pytest.mark.parametrize("option", ExportOptions.model_fields)
@pytest.mark.parametrize("name", PAINTED)
def test_an_option_changes_the_export_or_is_refused(
    name: str, option: str, dataset: Dataset, exported: dict[str, Path], tmp_path: Path
):
    if option not in export_format(name).options:
        with pytest.raises(InputError, match=f"format '{name}': has no use for --{option.replace('_', '-')}; it takes"):
            export(dataset, name, tmp_path / "out", ExportOptions(**{option: VALUES[option]}))
        return
    asked = {"validation": 0.3} if "validation" in export_format(name).options else {}
    export(dataset, name, tmp_path / "out", ExportOptions(**{**asked, option: VALUES[option]}))
    assert _contents(tmp_path / "out") != _contents(exported[name])


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
