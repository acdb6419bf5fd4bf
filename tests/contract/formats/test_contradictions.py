"""What contradicts itself in a folder of another format is told or refused by name, and right folders are silent."""

import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from painted_source import BARE, PaintedSource

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.formats.conversion import export, import_dataset
from flcav.dataset.formats.writing import ExportOptions
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.geometry import pose

About = dict[str, Any]
FORMATS = ("kitti", "nuscenes", "opv2v")
TABLES = "v1.0-flcav"
REFUSED_BOXES = (
    r"0 of \d+ boxes within 40 m of the LiDARs, or more than 250 m away, have points above the ground: labels"
)
EMPTY = r"\d+ of \d+ boxes within 40 m in view of the LiDARs have no points above the ground, as '.*' in painted-0-00"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("exports")
    record(PaintedSource(2), root / "dataset")
    for name in FORMATS:
        export(Dataset.open(root / "dataset"), name, root / name, ExportOptions(validation=0.5))
    return {name: root / name for name in FORMATS}


@pytest.fixture
def copied(exported: dict[str, Path], tmp_path: Path) -> Callable[[str], Path]:
    return lambda name: shutil.copytree(exported[name], tmp_path / name)


def change_yaml(folder: Path, change: Callable[[About], object], pattern: str = "*/*/*/0*.yaml") -> list[Path]:
    paths = sorted(folder.glob(pattern))
    for path in paths:
        about = yaml.safe_load(path.read_text())
        change(about)
        path.write_text(yaml.safe_dump(about))
    return paths


def change_rows(folder: Path, table: str, change: Callable[[list[About]], object]) -> Path:
    path = folder / TABLES / f"{table}.json"
    rows = json.loads(path.read_text())
    change(rows)
    path.write_text(json.dumps(rows))
    return path


def lift_kitti(folder: Path) -> None:
    for path in folder.glob("training/label_2/*.txt"):
        rows = [line.split() for line in path.read_text().splitlines()]
        lines = [" ".join((*row[:12], str(float(row[12]) - 8), *row[13:])) for row in rows if row[0] != "DontCare"]
        path.write_text("\n".join(lines) + "\n")


def lift_nuscenes(folder: Path) -> None:
    def lift(rows: list[About]) -> None:
        for row in rows:
            row["translation"][2] += 8

    change_rows(folder, "sample_annotation", lift)


def lift_opv2v(folder: Path) -> None:
    def lift(about: About) -> None:
        for row in about["vehicles"].values():
            row["location"][2] += 8

    change_yaml(folder, lift)


LIFTED: dict[str, Callable[[Path], None]] = {"kitti": lift_kitti, "nuscenes": lift_nuscenes, "opv2v": lift_opv2v}


@pytest.mark.parametrize("name", FORMATS)
def test_boxes_that_are_not_where_the_objects_are_are_told(name: str, copied: Callable[[str], Path], tmp_path: Path):
    folder = copied(name)
    bare = BARE if name == "kitti" else ()
    assert import_dataset(name, folder, tmp_path / "right") == bare
    LIFTED[name](folder)
    with pytest.raises(InputError, match=f"^{re.escape(str(folder))}: {REFUSED_BOXES}"):
        import_dataset(name, folder, tmp_path / "wrong")
    assert not (tmp_path / "wrong").exists()


def test_boxes_beyond_all_reach_are_told(copied: Callable[[str], Path], tmp_path: Path):
    def to_millimetres(about: About) -> None:
        for row in about["vehicles"].values():
            row["location"] = [1000 * each for each in row["location"]]

    folder = copied("opv2v")
    change_yaml(folder, to_millimetres)
    with pytest.raises(InputError, match=REFUSED_BOXES):
        import_dataset("opv2v", folder, tmp_path / "out")


def radians(values: list[float]) -> list[float]:
    return [*values[:3], *map(math.radians, values[3:])]


def test_a_pose_in_radians_beside_one_in_degrees_is_told(copied: Callable[[str], Path], tmp_path: Path):
    folder = copied("opv2v")
    first, *_ = change_yaml(folder, lambda about: about.update(lidar_pose=radians(about["lidar_pose"])))
    with pytest.raises(InputError, match=r"5 of 32 boxes within 40 m .*") as refused:
        import_dataset("opv2v", folder, tmp_path / "out")
    told = (
        rf"'lidar_pose' and 'true_ego_pos' contradict each other in \d of 8 frames, first in {first}, where the angles"
    )
    assert re.search(f"; {told} of one are those of the other in radians$", str(refused.value))


def test_two_poses_of_one_frame_that_contradict_each_other_are_told(copied: Callable[[str], Path], tmp_path: Path):
    folder = copied("opv2v")

    def turn(about: About) -> None:
        about["lidar_pose"][4] += 40
        about["lidar_pose"][0] += 0.5

    (path,) = change_yaml(folder, turn, "train/*/1001/000001.yaml")
    note, *_ = import_dataset("opv2v", folder, tmp_path / "out")
    assert f"in 1 of 8 frames, first in {path}, where they are 40.0 degrees and" in note


def as_matrix(values: list[float]) -> np.ndarray:
    """Return the 4 x 4 matrix of a pose in CARLA's left-handed frame, y to the right."""
    x, y, z, roll, yaw, pitch = values
    return pose(x, y, z, *np.radians((yaw, -pitch, -roll)))


def test_poses_of_4_by_4_numbers_are_those_of_6(
    exported: dict[str, Path], copied: Callable[[str], Path], tmp_path: Path
):
    def use_matrices(about: About) -> None:
        for owner, name in (
            (about, "lidar_pose"),
            (about, "true_ego_pos"),
            *((about[c], "cords") for c in about if "camera" in c),
        ):
            owner[name] = as_matrix(owner[name]).tolist()

    folder = copied("opv2v")
    change_yaml(folder, use_matrices)
    assert import_dataset("opv2v", folder, tmp_path / "matrices") == ()
    import_dataset("opv2v", exported["opv2v"], tmp_path / "numbers")
    one, other = Dataset.open(tmp_path / "matrices"), Dataset.open(tmp_path / "numbers")
    for i in range(len(other)):
        for sensor in other.frame(i).agent_from_sensor:
            mounted, expected = (data.frame(i).world_from_sensor(sensor) for data in (one, other))
            np.testing.assert_allclose(mounted, expected, atol=1e-7)


NO_ROTATION, NO_POSE = "'lidar_pose' has a matrix that is no rotation", "'lidar_pose' is not of 6 numbers, nor of 4 x 4"
WRONG_MATRICES: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "scaled": (
        lambda m: m * [[2], [2], [2], [1]],
        f"{NO_ROTATION}: it scales by 2, 2, 2",
    ),
    "mirrored": (lambda m: m @ np.diag((1, -1, 1, 1)), f"{NO_ROTATION}: it mirrors"),
    "transposed": (np.transpose, "the last row of 'lidar_pose' is not 0, 0, 0, 1"),
    "cut": (lambda m: m[:3], NO_POSE),
    "not finite": (lambda m: m * np.nan, NO_POSE),
}


@pytest.mark.parametrize("how", WRONG_MATRICES)
def test_a_matrix_that_is_no_pose_is_refused(how: str, copied: Callable[[str], Path], tmp_path: Path):
    change, sentence = WRONG_MATRICES[how]
    folder = copied("opv2v")
    (path,) = change_yaml(
        folder,
        lambda about: about.update(lidar_pose=change(as_matrix(about["lidar_pose"])).tolist()),
        "train/*/1001/000000.yaml",
    )
    with pytest.raises(InputError, match=f"^{re.escape(f'{path}: not a frame of OPV2V, {sentence}')}"):
        import_dataset("opv2v", folder, tmp_path / "out")


def test_two_files_of_one_frame_are_refused(copied: Callable[[str], Path], tmp_path: Path):
    folder = copied("opv2v")
    agent = next(folder.glob("train/*/1001"))
    for suffix in ("yaml", "pcd"):
        shutil.copy(agent / f"000001.{suffix}", agent / f"1.{suffix}")
    with pytest.raises(InputError, match=re.escape(f"{agent / '1.yaml'}: is frame 1, as 000001.yaml is; keep one")):
        import_dataset("opv2v", folder, tmp_path / "out")


def find_radar(rows: list[About]) -> About:
    return next(row for row in rows if "RADAR" in row["filename"])


def set_first(**values: object) -> Callable[[list[About]], object]:
    return lambda rows: rows[0].update(values)


NOWHERE = " of 1 row is the token of no row"
TOLD: list[tuple[str, Callable[[list[About]], object], str]] = [
    ("sample", set_first(next="nobody"), f"sample.json: 'next'{NOWHERE}, first of row 0"),
    ("sample_data", set_first(prev="nobody"), f"sample_data.json: 'prev'{NOWHERE}, first of row 0"),
    ("sample_annotation", set_first(next="x"), f"sample_annotation.json: 'next'{NOWHERE}"),
    ("sample_annotation", set_first(attribute_tokens=["x"]), f"'attribute_tokens'{NOWHERE}, first 'x'"),
    ("sample_annotation", set_first(visibility_token="9"), f"'visibility_token'{NOWHERE}, first '9'"),
    ("sample_data", lambda rows: find_radar(rows).update(sample_token="x"), f"'sample_token'{NOWHERE}, first 'x'"),
    ("scene", set_first(first_sample_token="x"), f"'first_sample_token'{NOWHERE}, first 'x'"),
    (
        "sample",
        lambda rows: rows[0].update(timestamp=rows[1]["timestamp"] + 1),
        "sample.json: 'next' of 1 row leads back in time, first of row 0",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("table", "change", "sentence"), TOLD)
def test_a_reference_to_nothing_is_told(
    table: str, change: Callable[[list[About]], object], sentence: str, copied: Callable[[str], Path], tmp_path: Path
):
    folder = copied("nuscenes")
    change_rows(folder, table, change)
    notes = import_dataset("nuscenes", folder, tmp_path / "out")
    assert any(sentence in note for note in notes), notes


REFUSED: list[tuple[str, Callable[[list[About]], object], str]] = [
    ("sample_data", lambda rows: rows[1].update(token=rows[0]["token"]), "the rows 0 and 1 have one token"),
    ("sample_annotation", lambda rows: rows[2].update(token=rows[0]["token"]), "the rows 0 and 2 have one token"),
    ("ego_pose", set_first(rotation=[2.0, 0.0, 0.0, 0.0]), "row 0 has a 'rotation' that is none: [2.0, 0.0, 0.0, 0.0]"),
    ("sample_annotation", set_first(size=[1800.0, 4200.0, 1500.0]), "object 1 is 4200 m long; sizes are wanted in"),
    ("sample_annotation", set_first(size=[math.nan, 4.2, 1.5]), "row 0 has a 'size' that is none: [nan, 4.2, 1.5]"),
    ("ego_pose", set_first(translation=[math.inf, 0, 0]), "row 0 has a 'translation' that is none: [inf, 0, 0]"),
]


@pytest.mark.parametrize(("table", "change", "sentence"), REFUSED)
def test_a_row_that_cannot_be_is_refused(
    table: str, change: Callable[[list[About]], object], sentence: str, copied: Callable[[str], Path], tmp_path: Path
):
    folder = copied("nuscenes")
    path = change_rows(folder, table, change)
    with pytest.raises(InputError, match=f"^{re.escape(f'{path}: {sentence}')}"):
        import_dataset("nuscenes", folder, tmp_path / "out")


def test_nuscenes_without_pictures_of_its_maps_is_read(copied: Callable[[str], Path], tmp_path: Path):
    folder = copied("nuscenes")
    (path,) = folder.glob("maps/*.png")
    path.unlink()
    assert import_dataset("nuscenes", folder, tmp_path / "out") == ()


def test_samples_of_one_time_are_refused_by_name(copied: Callable[[str], Path], tmp_path: Path):
    folder = copied("nuscenes")
    path = change_rows(folder, "sample", lambda rows: rows[1].update(timestamp=rows[0]["timestamp"]))
    one, other = sorted(row["token"] for row in json.loads(path.read_text())[:2])
    said = f"{path}: the samples '{one}' and '{other}' of the scene 'painted-0-000' have one time stamp, 10.000000 s"
    with pytest.raises(InputError, match=f"^{re.escape(said)}; correct it, or remove one of them"):
        import_dataset("nuscenes", folder, tmp_path / "out")


KITTI: list[tuple[str, str, str, str]] = [  # file, pattern, what replaces it, sentence
    ("calib", r"(R0_rect: )\S+", r"\g<1>2", "'R0_rect' has a matrix that is no rotation: it scales by 2, 1, 1"),
    ("calib", r"(R0_rect: )\S+", r"\g<1>-1", "'R0_rect' has a matrix that is no rotation: it mirrors"),
    ("label_2", r"^(\w+(?: \S+){13}) \S+", r"\g<1> 90", "object 1 is turned by 90; radians within a turn are wanted"),
    ("label_2", r"^(\w+(?: \S+){7}) \S+", r"\g<1> 1500", "object 1 has a side above 200 m; sizes are wanted in metres"),
]


@pytest.mark.parametrize(("part", "old", "new", "sentence"), KITTI)
def test_numbers_of_kitti_in_other_units_are_refused(
    part: str, old: str, new: str, sentence: str, copied: Callable[[str], Path], tmp_path: Path
):
    folder = copied("kitti")
    path = folder / "training" / part / "000000.txt"
    text, count = re.subn(old, new, path.read_text(), count=1, flags=re.MULTILINE)
    assert count
    path.write_text(text)
    with pytest.raises(InputError, match=f"^{re.escape(f'{path}: {sentence}')}"):
        import_dataset("kitti", folder, tmp_path / "out")


def test_one_frame_of_two_numbers_is_refused(copied: Callable[[str], Path], tmp_path: Path):
    folder = copied("kitti")
    path = folder / "frames.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join((*lines[:2], re.sub(r"painted-0-00._000._cav0", "painted-0-000_0000_cav0", lines[2]))))
    with pytest.raises(InputError, match=r"frames\.csv: 000001 is the frame 'painted-0-000_0000_cav0', as 000000 is"):
        import_dataset("kitti", folder, tmp_path / "out")


def test_what_files_say_does_not_reach_the_terminal_as_commands(
    copied: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder, name = copied("opv2v"), "\x1b[2J\nflcav: 8 frames, no problems\n" + "x" * 3000

    def rename(about: About) -> None:
        for index, row in enumerate(about["vehicles"].values()):
            row["location"][2] += 8 * (index > 0)  # most boxes, but not nearly all
        about["vehicles"] = {f"{name}{number}": row for number, row in about["vehicles"].items()}

    change_yaml(folder, rename)
    run_to_end(["import", "opv2v", str(folder), "--out", str(tmp_path / "out")])
    run_to_end(["validate", str(tmp_path / "out")])
    said = capsys.readouterr().out
    assert "\\x1b[2J" in said
    assert said.replace("\n", "").isprintable()
    assert not [line for line in said.splitlines() if line.startswith("flcav") or len(line) > 1010]


def run_to_end(arguments: list[str]) -> None:
    with pytest.raises(SystemExit):
        run(arguments)
