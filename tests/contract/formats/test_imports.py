"""Every format that is exported and imported keeps what both know; each damaged folder is one sentence."""

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import yaml
from painted_source import BARE, CATEGORIES, IN_BOX, PaintedSource
from PIL import Image

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.formats.conversion import export, import_dataset
from flcav.dataset.formats.formats import EXPORTS, IMPORTS
from flcav.dataset.formats.kitti.read import KittiSource
from flcav.dataset.formats.nuscenes.tables import COLUMNS
from flcav.dataset.formats.opv2v.files import read_cloud
from flcav.dataset.formats.writing import ExportOptions, split_scenes
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.dataset.validation import find_leaks, validate
from flcav.geometry import inverse, wrap_angle
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import Ledger
from flcav.runs.engine import Step, Work
from flcav.runs.frames import group_frames
from flcav.runs.recipe import EDGE, SPLITS_OF, RunRecipe
from flcav.runs.results.plans import Plan
from flcav.runs.results.saved import LEDGER
from flcav.runs.stages.graph import Graph
from flcav.sensors.frame import Frame

SCENES = 2
ROUND = [name for name in IMPORTS if name in EXPORTS]
SENSORS = {  # of cav0: name in the format -> name in the source
    "kitti": {"velodyne": "lidar", "image_2": "front"},
    "nuscenes": {"LIDAR_TOP": "lidar", "CAM_FRONT": "front", "CAM_BACK": "back", "RADAR_FRONT": "radar"},
    "opv2v": {"lidar": "lidar", "camera0": "front", "camera3": "back"},
}
METRES = {"kitti": 2e-4, "nuscenes": 1e-6, "opv2v": 1e-6}
INTENSITY = {"kitti": 0, "nuscenes": 1e-6, "opv2v": 0.5 / 255 + 1e-6}
CLASSES = {  # of those with another name than in the source
    "kitti": {"bus": "truck", "motorcycle": "bicycle"},
    "nuscenes": {"van": "car"},
    "opv2v": {"van": "car", "truck": "car", "bus": "car"},
}
TILTS, TRACKS, INSTANCES, VISIBILITY = ("nuscenes", "opv2v"), ("opv2v",), ("nuscenes",), ("nuscenes",)
LEVELS, SPEED = ("kitti",), ("opv2v",)  # formats that have them


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("painted") / "dataset"
    record(PaintedSource(SCENES, tilted=(1,)), folder)
    return Dataset.open(folder)


@pytest.fixture(scope="module")
def exported(source: Dataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("exports")
    for name in ROUND:
        export(source, name, root / name, ExportOptions(validation=0.5))
    return {name: root / name for name in ROUND}


@pytest.fixture(scope="module")
def imported(exported: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Dataset]:
    root = tmp_path_factory.mktemp("imports")
    for name, folder in exported.items():
        import_dataset(name, folder, root / name)
    return {name: Dataset.open(root / name) for name in exported}


def _pairs(name: str, source: Dataset, imported: Dataset) -> list[tuple[Frame, Frame]]:
    expected = [i for i in range(len(source)) if name != "kitti" or source.keys[i].agent == "cav0"]
    assert [imported.name(i) for i in range(len(imported))] == [source.name(i) for i in expected]
    return [(source.frame(i), imported.frame(number)) for number, i in enumerate(expected)]


@pytest.mark.parametrize("name", ROUND)
def test_an_export_is_imported_as_it_was(name: str, source: Dataset, imported: dict[str, Dataset]):
    dataset = imported[name]
    assert validate(dataset.folder) == []
    assert split_scenes(dataset, ExportOptions()) == {"painted-0-000": "train", "painted-0-001": "val"}
    for old, new in _pairs(name, source, dataset):
        sensors = {own: was for own, was in SENSORS[name].items() if was in old.calibration.agent_from_sensor}
        assert {*new.lidar, *new.images, *new.radar} == sensors.keys()
        lidar = next(iter(new.lidar))
        np.testing.assert_allclose(new.lidar[lidar][:, :3], old.lidar["lidar"][:, :3], atol=1e-5)
        np.testing.assert_allclose(new.lidar[lidar][:, 3], old.lidar["lidar"][:, 3], atol=INTENSITY[name] + 1e-9)
        for own in new.radar:
            np.testing.assert_allclose(new.radar[own], old.radar[sensors[own]], atol=1e-4)
        lidar_from_world, lidar_from_past = (
            inverse(new.world_from_sensor(lidar)),
            inverse(old.world_from_sensor("lidar")),
        )
        for own in new.images:
            np.testing.assert_array_equal(new.images[own].rgb, old.images[sensors[own]].rgb)
            assert new.images[own].depth_m is None
            np.testing.assert_allclose(new.calibration.intrinsics[own], old.calibration.intrinsics[sensors[own]])
            pose, past = lidar_from_world @ new.world_from_sensor(own), old.world_from_sensor(sensors[own])
            np.testing.assert_allclose(pose, lidar_from_past @ past, atol=1e-6)
        if name == "nuscenes":  # whose global frame is the world, shifted
            between = new.world_from_agent @ inverse(old.world_from_agent)
            np.testing.assert_allclose(between[:3, :3], np.eye(3), atol=1e-9)
            np.testing.assert_allclose(new.agent_from_sensor[lidar], old.agent_from_sensor["lidar"], atol=1e-9)
        if name == "opv2v":
            np.testing.assert_allclose(new.world_from_sensor(lidar), old.world_from_sensor("lidar"), atol=1e-6)
            np.testing.assert_allclose(new.agent_from_sensor[lidar], old.agent_from_sensor["lidar"], atol=1e-6)
        else:
            assert new.time_s == pytest.approx(old.time_s, abs=1e-6)


@pytest.mark.parametrize(("share", "scenes", "held_out"), [(0.07, 100, 7), (0.28, 25, 7), (0.2, 11, 3), (0.0, 5, 0)])
def test_a_share_of_the_scenes_is_the_number_that_it_says(share: float, scenes: int, held_out: int) -> None:
    keys, manifest = [SimpleNamespace(scene=f"s{i}") for i in range(scenes)], SimpleNamespace(recipe={}, split_of={})
    dataset = cast(Dataset, SimpleNamespace(keys=keys, manifest=manifest))
    assert [*split_scenes(dataset, ExportOptions(validation=share)).values()].count("val") == held_out


@pytest.mark.parametrize("name", ROUND)
def test_objects_of_an_export_are_imported_as_they_were(name: str, source: Dataset, imported: dict[str, Dataset]):
    instances: dict[tuple[str, str], dict[str, str]] = {}  # scene and agent -> its tracks: in the source, here
    for old, new in _pairs(name, source, imported[name]):
        truth, found = old.annotations, new.annotations
        boxes = found.boxes.transform(inverse(new.world_from_sensor(next(iter(new.lidar)))))
        was = truth.boxes.transform(inverse(old.world_from_sensor("lidar")))
        away = np.linalg.norm(boxes.center[:, None] - was.center[None], axis=2)
        row = away.argmin(axis=1)
        assert len(set(row)) == len(row) > 0
        if name in TILTS:
            np.testing.assert_allclose(boxes.center, was.center[row], atol=METRES[name])
        feet, past = (each.center - each.rotations()[:, :, 2] * each.size[:, 2:] / 2 for each in (boxes, was[row]))
        np.testing.assert_allclose(feet, past, atol=METRES[name])
        np.testing.assert_allclose(boxes.size, was.size[row], atol=METRES[name])
        np.testing.assert_allclose(wrap_angle(boxes.yaw - was.yaw[row]), 0, atol=METRES[name])
        other = CLASSES[name]
        assert found.boxes.label.tolist() == [other.get(CATEGORIES[i], CATEGORIES[i]) for i in row]
        if name in TILTS:
            np.testing.assert_allclose(boxes.rotations(), was[row].rotations(), atol=METRES[name])
            np.testing.assert_array_equal(found.returns, IN_BOX[row])
        else:  # whose boxes are upright in the camera's frame
            assert boxes.tilt is None
            assert (found.returns <= IN_BOX[row]).all()
            assert was.tilt is not None or (found.returns == IN_BOX[row]).all()
        assert np.isnan(found.acceleration).all()
        if name in TRACKS:
            assert found.track.tolist() == truth.track[row].tolist()
        if name in INSTANCES:
            scene = instances.setdefault((new.scene, new.agent), {})
            assert [scene.setdefault(was, now) for was, now in zip(truth.track[row], found.track)] == list(found.track)
            assert len(set(scene.values())) == len(scene)
        if name in VISIBILITY:
            assert (
                np.digitize(found.occlusion, (0.2, 0.4, 0.6))
                == np.digitize(truth.occlusion[row], (0.2, 0.4, 0.6 + 1e-9))
            ).all()
        else:
            assert np.isnan(found.occlusion).all()
        if name in SPEED:
            speed = np.linalg.norm(truth.velocity[row], axis=1)
            np.testing.assert_allclose(np.linalg.norm(found.velocity, axis=1), speed, atol=1e-6)
        if name in LEVELS:
            views, past = found.views["image_2"], truth.views["front"]
            np.testing.assert_allclose(views.truncation, past.truncation[row], atol=1e-4)
            level = np.where(past.pixels[row] > 0, np.digitize(past.occlusion[row], (0.1, 0.5)), 3)
            np.testing.assert_array_equal(np.nan_to_num(np.digitize(views.occlusion, (0.1, 0.5))), np.minimum(level, 2))
            assert (np.isnan(views.occlusion) == (level == 3)).all()
        for camera in () if name in LEVELS else new.images:
            """Rectangles are computed of boxes, and so are those of the painted pictures."""
            rectangle, past = found.views[camera].amodal_box, truth.views[SENSORS[name][camera]]
            whole = past.truncation[row] < 1
            np.testing.assert_allclose(rectangle[whole], past.amodal_box[row][whole], atol=1e-2)


@pytest.mark.parametrize("name", ROUND)
def test_what_is_imported_is_exported_as_it_came(
    name: str, exported: dict[str, Path], imported: dict[str, Dataset], tmp_path: Path
):
    """But for points' intensity by half a step, and what is not known: speeds of the agents, and attributes by them."""
    export(imported[name], name, tmp_path / "again")
    again = {path.relative_to(tmp_path / "again") for path in (tmp_path / "again").rglob("*") if path.is_file()}
    assert again == {path.relative_to(exported[name]) for path in exported[name].rglob("*") if path.is_file()}
    if name == "kitti":
        for path in sorted((tmp_path / "again" / "training" / "label_2").iterdir()):
            lines = (exported[name] / "training" / "label_2" / path.name).read_text().splitlines()
            known = [line.split() for line in lines if not line.startswith("DontCare")]
            for was, now in zip(known, (line.split() for line in path.read_text().splitlines()), strict=True):
                assert (was[0], was[2]) == (now[0], now[2])
                np.testing.assert_allclose([*map(float, now[3:])], [*map(float, was[3:])], atol=5e-4)


def test_links_are_made_where_nothing_is_to_be_converted(imported: dict[str, Dataset], exported: dict[str, Path]):
    folder = imported["kitti"].folder
    cloud = folder / "velodyne" / f"{imported['kitti'].name(0)}.bin"
    assert cloud.is_symlink()
    assert cloud.resolve() == (exported["kitti"] / "training" / "velodyne" / "000000.bin").resolve()
    assert imported["nuscenes"].plane_path(0, "CAM_FRONT", "rgb").is_symlink()


def _in_order(steps: Mapping[str, Step], last: str) -> list[str]:
    """Return the names of what the step `last` needs, and its own, each after those it needs."""
    return list(dict.fromkeys([*(name for each in steps[last].needs for name in _in_order(steps, each)), last]))


def test_vehicles_of_an_import_are_clients_of_a_region(imported: dict[str, Dataset], tmp_path: Path):
    data = {split: str(imported["opv2v"].folder) for split in ("pool", *SPLITS_OF["federate"])}
    recipe = RunRecipe.model_validate(
        {
            "training": {"steps": 1, "local_steps": 1},
            "splits": {name: {"scenes": 2, "spins": 1, "cavs": 3} for name in data},  # three vehicles if not known
            "tasks": {"objects": {"plan": {"samples": 2, "edge_rounds": 1, "cloud_rounds": 0}}},
            "regions": {"first": {"role": "pretrain", "data": data}, "streets": {"role": "federate", "data": data}},
            "budgets_mb": {"wireless": 3, "wireline": 3},
        }
    )
    steps = {step.name: step for step in Graph(recipe, tmp_path).steps}
    for name in _in_order(steps, "streets-edge-fl-objects"):
        (tmp_path / name).mkdir()
        inputs = {each: tmp_path / each for each in steps[name].needs}
        steps[name].run(Work(tmp_path / name, inputs, ignore_progress), **steps[name].arguments)
    entries = Ledger.load(tmp_path / "streets-edge-fl-objects" / LEDGER).entries
    sent = [entry for entry in entries if (entry.link, entry.direction) == ("wireless", "up")]
    (update,) = (entry for entry in sent if entry.round)
    plan = Plan.load(tmp_path / "plan").tasks["objects"]
    assert {(entry.stage, entry.client) for entry in sent} == {(EDGE, "streets/cav0")}
    rounds_mb = plan.wireless_mb - plan.samples * plan.sample_mb
    assert rounds_mb == pytest.approx(update.bytes / 1e6, rel=0.1)  # planned for one vehicle, not for three
    grouped = group_frames(imported["opv2v"], "imported")
    assert grouped.poles.keys() == {3}


def test_a_split_alone_is_imported(exported: dict[str, Path], tmp_path: Path):
    for name, folder in exported.items():
        import_dataset(name, folder, tmp_path / name, split="val")
        data = Dataset.open(tmp_path / name)
        assert {key.scene for key in data.keys} == {"painted-0-001"}
        assert set(split_scenes(data, ExportOptions()).values()) == {"val"}
        with pytest.raises(InputError, match="no split 'holiday'; it has train, val"):
            import_dataset(name, folder, tmp_path / "none", split="holiday")
    import_dataset("kitti", exported["kitti"], tmp_path / "train", split="train")
    manifests = {part: Dataset.open(tmp_path / part).manifest for part in ("kitti", "train")}
    assert find_leaks(manifests) == []


def _first(folder: Path, pattern: str) -> Path:
    return sorted(folder.glob(pattern))[0]


LOST, IMAGE = "no such file", "an image, or a truncated one"
DAMAGES = {  # format -> pattern of a file, and the sentence where it is missing, cut in half, and empty
    "kitti": [
        ("training/velodyne/*.bin", LOST, "truncated", "empty; a point cloud holds"),
        ("training/calib/*.txt", LOST, "needs 12 numbers|needs 9 numbers", "needs 12 numbers"),
        ("training/image_2/*.png", None, "a truncated image", IMAGE),
        ("training/label_2/*.txt", LOST, "is no KITTI label", None),
    ],
    "nuscenes": [
        *((f"v1.0-flcav/{table}.json", LOST, "not JSON", "not JSON") for table in COLUMNS if table != "sample"),
        ("v1.0-flcav/sample.json", None, "not JSON", "not JSON"),  # without it there are no tables
        ("v1.0-flcav/splits.json", None, "not JSON", "not JSON"),
        ("samples/LIDAR_TOP/*.bin", None, "truncated", "truncated"),
        ("samples/RADAR_FRONT/*.pcd", None, "truncated|not a binary PCD file", "not a binary PCD file"),
        ("samples/CAM_FRONT/*.png", None, "a truncated image", IMAGE),
    ],
    "opv2v": [
        ("train/*/*/*.pcd", None, "truncated", "not a binary PCD file"),
        ("train/*/*/*_camera0.png", None, "a truncated image", None),
        ("train/*/*/000000.yaml", None, "not a YAML file|not a frame of OPV2V", "not a frame of OPV2V"),
        ("train/*/data_protocol.yaml", None, "not a YAML file", None),  # another's has no names
    ],
}


@pytest.mark.parametrize(
    ("name", "pattern", "how", "sentence"),
    [
        (name, pattern, how, sentence)
        for name, damages in DAMAGES.items()
        for pattern, *sentences in damages
        for how, sentence in zip(("missing", "half", "empty"), sentences, strict=True)
        if sentence is not None
    ],
)
def test_a_missing_or_truncated_file_names_itself(
    name: str,
    pattern: str,
    how: str,
    sentence: str,
    exported: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    folder = tmp_path / "folder"
    shutil.copytree(exported[name], folder)
    path = _first(folder, pattern)
    if how == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 - 1] if how == "half" else b"")
    with pytest.raises(SystemExit) as ended:
        run(["import", name, str(folder), "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.removeprefix("flcav: ").startswith(f"{path}: ")
    assert re.search(sentence, said)
    assert not (tmp_path / "out").exists()


LOST_FILES = "files of its tables that are not there: {}, the first is .*; left out with them: {} of 8 key frames"
LEFT_OUT = [  # format, pattern of the files that are lost (the first of them, or all), frames, pictures, the sentence
    ("kitti", "training/image_2/*.png", False, 4, 3, "no image_2 of 1 of 4 frames, so LiDAR alone there"),
    ("kitti", "training/image_2/*.png", True, 4, 0, "no image_2 of 4 of 4 frames, so LiDAR alone there"),
    ("nuscenes", "samples/LIDAR_TOP/*.bin", False, 7, 6, LOST_FILES.format(1, 1)),
    ("nuscenes", "samples/RADAR_FRONT/*.pcd", True, 8, 8, LOST_FILES.format(4, 0)),
    ("nuscenes", "samples/CAM_FRONT/*.png", True, 8, 4, LOST_FILES.format(4, 0)),
    ("opv2v", "train/*/*/*.pcd", False, 7, 6, "left out 1 of 8 frames: .* no point cloud of painted-0-000/1001/000000"),
    ("opv2v", "train/*/*/000000.yaml", False, 7, 6, "left out 1 of 8 frames: no YAML file or no point cloud"),
    (
        "opv2v",
        "train/*/*/*_camera0.png",
        False,
        8,
        7,
        "of 1 of 8 frames, .*: painted-0-000/1001/000000_camera0",
    ),
]


@pytest.mark.parametrize(("name", "pattern", "every", "frames", "pictures", "sentence"), LEFT_OUT)
def test_what_is_there_is_read_and_what_is_not_is_told(
    name: str,
    pattern: str,
    every: bool,
    frames: int,
    pictures: int,
    sentence: str,
    exported: dict[str, Path],
    tmp_path: Path,
):
    folder = shutil.copytree(exported[name], tmp_path / "folder")
    paths = sorted(folder.glob(pattern))
    for path in paths if every else paths[:1]:
        path.unlink()
    notes = import_dataset(name, folder, tmp_path / "out")
    assert any(re.search(sentence, note) for note in notes), notes
    data = Dataset.open(tmp_path / "out")
    assert (len(data), sum(len(data.frame(i).images) for i in range(len(data)))) == (frames, pictures)
    assert validate(tmp_path / "out") == []


@pytest.mark.parametrize(
    ("name", "pattern", "sentence"),
    [
        ("nuscenes", "samples/LIDAR_TOP/*", "no such file, nor is that of any other sweep of LIDAR_TOP"),
        ("opv2v", "*/*/*/*.pcd", "none of 8 frames has both a YAML file and a point cloud"),
    ],
)
def test_nothing_that_is_there_is_one_sentence(
    name: str, pattern: str, sentence: str, exported: dict[str, Path], tmp_path: Path
):
    folder = shutil.copytree(exported[name], tmp_path / "folder")
    for path in folder.glob(pattern):
        path.unlink()
    with pytest.raises(InputError, match=sentence):
        import_dataset(name, folder, tmp_path / "out")


def test_files_of_v2x_real_are_read(exported: dict[str, Path], imported: dict[str, Dataset], tmp_path: Path):
    folder = shutil.copytree(exported["opv2v"], tmp_path / "folder")
    for path in sorted(folder.rglob("*.pcd")):
        points = read_cloud(path) * np.array([1, -1, 1, 255], np.float32)
        lost = np.full((3, 4), np.nan, np.float32)
        path.with_suffix(".bin").write_bytes(np.concatenate((points, lost)).tobytes())
        path.unlink()
    for path in sorted(folder.rglob("*_camera*.png")):
        name = path.name.replace("camera0", "cam1").replace("camera3", "cam4").replace(".png", ".jpeg")
        with Image.open(path) as picture:
            picture.convert("RGB").save(path.with_name(name), quality=95)
        path.unlink()
    next(folder.rglob("*_cam1.jpeg")).write_bytes(b"")  # as one of V2X-Real is
    for path in folder.rglob("0*.yaml"):
        about = yaml.safe_load(path.read_text())
        about["true_ego_pose"] = [np.float64(each) for each in about.pop("true_ego_pos")]
        for old, new in (("camera0", "cam1"), ("camera3", "cam4")):
            if old in about:
                about[new] = {**about.pop(old), "extrinsic": np.eye(4)}
        for row in about["vehicles"].values():
            row["location"] = np.add(row["location"], row.pop("center"))  # an array of NumPy's
            row["obj_type"] = "Pedestrian"
        path.write_text(yaml.dump(about) + "noise: 1e-05\n")
    notes = import_dataset("opv2v", folder, tmp_path / "out")
    (note,) = notes
    told = r"no picture of a camera of 1 of 8 frames, so no image there: painted-0-00\d/1001/00000\d_cam1"
    assert re.fullmatch(told, note)
    before, after = imported["opv2v"], Dataset.open(tmp_path / "out")
    assert len(after) == len(before)
    for i in range(len(before)):
        one, other = before.frame(i), after.frame(i)
        np.testing.assert_allclose(other.lidar["lidar"], one.lidar["lidar"], atol=1e-6)
        np.testing.assert_allclose(other.annotations.boxes.array(), one.annotations.boxes.array(), atol=1e-9)
        assert set(other.annotations.boxes.label) <= {"pedestrian"}
    assert {name for i in range(len(after)) for name in after.cameras(i)} == {"cam1", "cam4"}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("!!python/object/apply:os.system ['touch owned']", "not a YAML file"),
        ("!!python/object/apply:numpy.core.multiarray.scalar [1, 2]", "a number of NumPy's without its bytes"),
        ("!!python/object/apply:numpy.dtype {args: [O8, false, true]}", "numbers of an unknown kind, 'O8'"),
        ("!!python/object/apply:numpy.core.multiarray._reconstruct {args: [], state: [1]}", "without its state"),
        ("!!python/name:os.system ''", "not a YAML file"),
    ],
)
def test_other_objects_of_python_are_refused(text: str, sentence: str, exported: dict[str, Path], tmp_path: Path):
    folder = shutil.copytree(exported["opv2v"], tmp_path / "folder")
    path = _first(folder, "train/*/*/000000.yaml")
    path.write_text(f"{path.read_text()}\nextra: {text}\n")
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: .*{sentence}"):
        import_dataset("opv2v", folder, tmp_path / "out")
    assert not Path("owned").exists()


def test_a_byte_order_mark_is_no_part_of_a_name(exported: dict[str, Path], tmp_path: Path):
    for name, pattern in (("kitti", "**/*.txt"), ("nuscenes", "v1.0-flcav/*.json"), ("opv2v", "**/*.yaml")):
        folder = shutil.copytree(exported[name], tmp_path / name)
        for path in folder.glob(pattern):
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
        assert import_dataset(name, folder, tmp_path / f"{name}-out") == (BARE if name == "kitti" else ())


ODD = [  # format, pattern of a file, what is replaced in it, by what, and the sentence
    ("kitti", "training/label_2/*.txt", r"^(\w+ \S+) \d", r"\1 7.5e300", "object 1 has an occlusion that is none of"),
    ("kitti", "ImageSets/val.txt", r"\A", "000000\n", "lists the frame 000000, which 'train' lists, too"),
    *(
        ("nuscenes", f"v1.0-flcav/{table}.json", pattern, new, sentence)
        for table, pattern, new, sentence in (
            (
                "sample_annotation",
                r'"size": \[[^]]*\]',
                '"size": [0, 4, 2]',
                "object 1 has a size that is not positive",
            ),
            (
                "calibrated_sensor",
                r'"camera_intrinsic": \[\s*\[[^}]*?\]\s*\]',
                '"camera_intrinsic": []',
                "a camera has no matrix",
            ),
            ("sample_data", r'"width": [1-9]\d*', '"width": 0', "no width and height of 'samples/CAM_"),
            ("sensor", r'"modality": "lidar"', '"modality": "sonar"', "row 0 has a 'modality' that is none: 'sonar'"),
            ("scene", r'"name": "scene-\d+"', '"name": "seven"', "the scene 'seven' is none of an export by flcav"),
        )
    ),
    ("opv2v", "train/*/*/000000.yaml", r"speed: .*", "speed: fast", "not a frame of OPV2V, a number is wanted"),
    ("opv2v", "train/*/*/000000.yaml", r"^vehicles:", "objects:", "not a frame of OPV2V, it has no 'vehicles'"),
    (
        "opv2v",
        "train/*/*/000000.yaml",
        r"(extent:\s*(?:\[|- ))[\d.]+",
        r"\g<1>0",
        "object 1 has a size that is not",
    ),
]


@pytest.mark.parametrize(("name", "pattern", "old", "new", "sentence"), ODD)
def test_a_file_with_an_impossible_entry_names_itself(
    name: str, pattern: str, old: str, new: str, sentence: str, exported: dict[str, Path], tmp_path: Path
):
    folder = shutil.copytree(exported[name], tmp_path / "folder")
    path = _first(folder, pattern)
    text, count = re.subn(old, new, path.read_text(), flags=re.MULTILINE)
    assert count
    path.write_text(text)
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: {re.escape(sentence)}"):
        import_dataset(name, folder, tmp_path / "out")


def test_a_listed_frame_of_kitti_without_any_file_names_itself(exported: dict[str, Path], tmp_path: Path):
    folder = shutil.copytree(exported["kitti"], tmp_path / "folder")
    with (folder / "ImageSets" / "train.txt").open("a") as file:
        file.write("000099\n")
    with pytest.raises(InputError, match=r"training/calib/000099\.txt: no such file; a frame of KITTI has one"):
        import_dataset("kitti", folder, tmp_path / "out")


def test_kitti_without_labels_and_opv2v_without_pictures_say_so(exported: dict[str, Path], tmp_path: Path):
    folder = shutil.copytree(exported["kitti"], tmp_path / "kitti")
    shutil.rmtree(folder / "training" / "label_2")
    notes = import_dataset("kitti", folder, tmp_path / "bare")
    assert notes == (
        *BARE,
        "no label_2 of 4 of 4 frames, so no boxes there: 000000, 000001, 000002 and 1 more",
    )
    folder = shutil.copytree(exported["opv2v"], tmp_path / "opv2v")
    for path in folder.rglob("*_camera3.png"):
        path.unlink()
    assert import_dataset("opv2v", folder, tmp_path / "blind") == (
        "no pictures of a camera of 1 of 2 agents, so no images of it: camera3 of cav0",
    )
    assert set(Dataset.open(tmp_path / "blind").frame(0).images) == {"camera0"}


def test_an_import_goes_on_once_a_file_is_replaced(
    exported: dict[str, Path], imported: dict[str, Dataset], tmp_path: Path
):
    folder, out = shutil.copytree(exported["nuscenes"], tmp_path / "folder"), tmp_path / "out"
    path = sorted((folder / "samples" / "LIDAR_TOP").iterdir())[-1]
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    with pytest.raises(InputError, match="truncated"):
        import_dataset("nuscenes", folder, out)
    path.write_bytes(data)
    import_dataset("nuscenes", folder, out)
    whole = imported["nuscenes"].folder
    names = sorted(file.relative_to(whole) for file in whole.rglob("*") if file.is_file())
    assert names == sorted(file.relative_to(out) for file in out.rglob("*") if file.is_file())
    for name in names:
        if name.name != "manifest.json":  # which says where it is from
            assert (out / name).read_bytes() == (whole / name).read_bytes(), name


def test_beams_and_range_are_known_of_kitti_itself(exported: dict[str, Path], tmp_path: Path):
    folder = shutil.copytree(exported["kitti"], tmp_path / "kitti")
    assert KittiSource(folder).describe().keys().isdisjoint({"beams", "range_m"})
    (folder / "frames.csv").unlink()
    described = KittiSource(folder).describe()
    assert (described["beams"], described["range_m"]) == (64, 120)


@pytest.mark.parametrize("name", IMPORTS)
def test_a_folder_of_another_format_is_one_sentence(name: str, exported: dict[str, Path], tmp_path: Path):
    other = "nuscenes" if name == "kitti" else "kitti"
    with pytest.raises(InputError, match=f"is no folder of '{name}' but of '{other}'"):
        import_dataset(name, exported[other], tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty: no "):
        import_dataset(name, tmp_path / "empty", tmp_path / "out")
    with pytest.raises(InputError, match="nowhere: no such folder"):
        import_dataset(name, tmp_path / "nowhere", tmp_path / "out")


def test_nuscenes_without_tables_or_boxes(exported: dict[str, Path], tmp_path: Path):
    shutil.copytree(exported["nuscenes"], tmp_path / "bare")
    for table in ("sample_annotation", "instance"):
        (tmp_path / "bare" / "v1.0-flcav" / f"{table}.json").write_text("[]")
    assert import_dataset("nuscenes", tmp_path / "bare", tmp_path / "out") == (
        "no annotations in its tables, so no boxes",
    )
    with pytest.raises(InputError, match="imported from nuscenes without labels of objects"):
        Dataset.open(tmp_path / "out").check_labelled("objects")
    shutil.rmtree(tmp_path / "bare" / "v1.0-flcav")
    with pytest.raises(InputError, match="no nuScenes tables"):
        import_dataset("nuscenes", tmp_path / "bare", tmp_path / "out2")


def test_a_row_that_refers_to_nothing(exported: dict[str, Path], tmp_path: Path):
    shutil.copytree(exported["nuscenes"], tmp_path / "odd")
    path = tmp_path / "odd" / "v1.0-flcav" / "instance.json"
    rows = json.loads(path.read_text())
    for text in (json.dumps([{**row, "category_token": "?"} for row in rows]), "[]"):  # of no category, of no instance
        path.write_text(text)
        with pytest.raises(InputError, match=r"its tables do not fit together, nothing has the token '"):
            import_dataset("nuscenes", tmp_path / "odd", tmp_path / "out")
    (path.parent / "scene.json").write_text("[]")
    with pytest.raises(InputError, match="no scenes in it"):
        import_dataset("nuscenes", tmp_path / "odd", tmp_path / "out")


def test_a_signalling_nan_is_one_sentence(exported: dict[str, Path], tmp_path: Path, recwarn: pytest.WarningsRecorder):
    folder = shutil.copytree(exported["opv2v"], tmp_path / "folder")
    path = _first(folder, "train/*/*/*.pcd")
    head, data, body = path.read_bytes().partition(b"DATA binary\n")
    path.write_bytes(head + data + b"\x01\x00\x80\x7f" + body[4:])
    with pytest.raises(InputError, match="point 0 is not finite"):
        import_dataset("opv2v", folder, tmp_path / "out")
    assert not recwarn.list
