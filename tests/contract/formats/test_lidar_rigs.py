"""LiDARs whose log does not say how they are mounted: height, tilt and beams by their sweeps, against cast rays."""

from pathlib import Path

import numpy as np
import pytest
from kitti_folders import cast, write_folder

from flcav.config import InputError
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.formats.kitti.files import read_points
from flcav.dataset.formats.mounting import estimate_mounting
from flcav.dataset.formats.rig import HEIGHT_M, UNSTATED, LidarRig, StatedLidar, find_rig
from flcav.dataset.store import Dataset
from flcav.geometry.poses import pose


@pytest.mark.parametrize("beams", [16, 32, 64, 128])
@pytest.mark.parametrize(("height_m", "pitch", "roll"), [(1.2, 0.0, 0.0), (1.6, 0.05, -0.08), (2.3, -0.03, 0.02)])
def test_mounting_and_beams(beams: int, height_m: float, pitch: float, roll: float) -> None:
    found = estimate_mounting([cast(beams, height_m, pitch, roll, seed) for seed in range(2)])
    assert found is not None
    np.testing.assert_allclose(found.agent_from_lidar, pose(0, 0, height_m, 0, pitch, roll), atol=0.02)
    assert (found.beams, found.sweeps) == (beams, 2)


def test_a_sweep_without_ground_shows_none() -> None:
    assert estimate_mounting([cast(64, 1.7, 0, 0, seed, ground=False) for seed in range(2)]) is None


def rig(tmp_path: Path, clouds: list[np.ndarray], stated: StatedLidar = UNSTATED) -> LidarRig:
    paths = [tmp_path / f"{number:06d}.bin" for number in range(len(clouds))]
    for path, cloud in zip(paths, clouds, strict=True):
        cloud.tofile(path)
    return find_rig(paths, read_points, stated)


def test_kittis_own_is_taken_as_it_is(tmp_path: Path) -> None:
    found = rig(tmp_path, [cast(64, 1.78, 0.01, -0.02, seed) for seed in range(5)])
    np.testing.assert_array_equal(found.agent_from_lidar, pose(0, 0, HEIGHT_M))
    assert (found.beams, found.notes) == (64, ())


def test_another_is_corrected_and_said(tmp_path: Path) -> None:
    found = rig(tmp_path, [cast(16, 1.4, 0.05, -0.08, seed) for seed in range(5)])
    np.testing.assert_allclose(found.agent_from_lidar, pose(0, 0, 1.4, 0, 0.05, -0.08), atol=0.02)
    assert found.notes[0] == "some 16 beams by the angles between returns, not KITTI's 64"
    assert found.notes[1].startswith("the ground of 5 sweeps lies 1.40 m (+- 0.0")
    assert found.notes[1].endswith("and the LiDAR is tilted by 5 degrees against it (corrected)")


def test_few_sweeps_do_not_tell_a_tilt_from_a_slope(tmp_path: Path) -> None:
    found = rig(tmp_path, [cast(64, 1.73, 0.05, -0.08, seed) for seed in range(2)])
    np.testing.assert_array_equal(found.agent_from_lidar, pose(0, 0, HEIGHT_M))


def test_what_is_stated_is_taken(tmp_path: Path) -> None:
    found = rig(tmp_path, [cast(16, 1.4, 0, 0, seed) for seed in range(5)], StatedLidar(2.0, 20))
    np.testing.assert_array_equal(found.agent_from_lidar, pose(0, 0, 2.0))
    assert (found.beams, found.notes) == (20, ())


def test_without_ground_it_is_taken_for_kittis_and_said(tmp_path: Path) -> None:
    found = rig(tmp_path, [cast(64, 1.7, 0, 0, seed, ground=False) for seed in range(2)])
    assert found.notes == ("no ground near the LiDAR in most of 2 sweeps, so it is taken to be 1.73 m above it",)


@pytest.mark.parametrize("stated", [{"height_m": -1.0}, {"height_m": float("nan")}, {"beams": 0}])
def test_impossible_statements_are_refused(stated: dict[str, float]) -> None:
    with pytest.raises(InputError, match="are wanted"):
        StatedLidar(**stated)  # type: ignore[arg-type]


def test_an_import_has_the_mount_and_beams(tmp_path: Path) -> None:
    write_folder(tmp_path / "in", [cast(16, 1.4, 0.05, -0.08, seed) for seed in range(5)])
    notes = import_dataset("kitti", tmp_path / "in", tmp_path / "out")
    assert notes[0] == "some 16 beams by the angles between returns, not KITTI's 64"
    data = Dataset.open(tmp_path / "out")
    assert data.manifest.recipe["beams"] == 16
    np.testing.assert_allclose(data.frame(0).agent_from_sensor["velodyne"], pose(0, 0, 1.4, 0, 0.05, -0.08), atol=0.02)
