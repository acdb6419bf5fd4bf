"""Poses of vehicles by which the static points that both see lie metres apart are refused; right ones are not."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flcav.config import InputError
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.formats.reading import ImportFormat, LogSource, annotate
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse, pose, transform_points
from flcav.sensors.frame import Calibration, Frame

MOUNT, TRUE = pose(0, 0, 1.7), {"one": pose(0, 0, 0, 0.1), "two": pose(12, 5, 0, 2.0)}


class TwoVehicles(LogSource):
    """Two vehicles between posts; the file `error` in the folder has how far one's pose is off to the east [m]."""

    FORMAT = "two-vehicles"
    split = None

    def __init__(self, folder: Path, split: str | None = None) -> None:
        self.folder, self.split_of = folder, {"scene": None}
        self.off_m = float((folder / "error").read_text())

    def frame_count(self, scene: str) -> int:
        return 4

    def frames(self, scene: str) -> Iterator[Frame]:
        rng = np.random.default_rng(1)
        foot = np.repeat(rng.uniform(-30, 40, (150, 2)), 8, axis=0)
        posts = np.column_stack((foot, rng.uniform(0.6, 3, len(foot))))
        for index in range(2):
            for agent, place in TRUE.items():
                seen = posts + rng.normal(0, 0.03, posts.shape)
                points = transform_points(inverse(place @ MOUNT), seen)
                cloud = np.column_stack((points, np.full(len(points), 0.5))).astype(np.float32)
                said = pose(self.off_m if agent == "two" else 0.0, 0) @ place
                truth = annotate([], Boxes.empty(), {"lidar": (cloud, said @ MOUNT)}, {})
                known = Calibration({"lidar": MOUNT})
                yield Frame(
                    scene, index, index / 10, agent, said, known, known, lidar={"lidar": cloud}, annotations=truth
                )


IMPORT = ImportFormat(TwoVehicles)


@pytest.mark.parametrize(("off_m", "told"), [(0.0, ""), (0.4, ""), (-4.0, "in 2 of 2"), (3.0, "in 2 of 2")])
def test_metres_are_refused_and_decimetres_are_not(off_m: float, told: str, tmp_path: Path):
    (tmp_path / "error").write_text(str(off_m))
    out, name = tmp_path / "out", f"{__name__}:IMPORT"
    if told:
        said = rf"the static points of two vehicles lie metres apart {told} pairs of frames, first {abs(off_m):.1f} m"
        with pytest.raises(InputError, match=said):
            import_dataset(name, tmp_path, out)
        assert not out.exists()
    else:
        assert import_dataset(name, tmp_path, out) == ()
        assert len(Dataset.open(out)) == 4
