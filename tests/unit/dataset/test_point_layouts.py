"""Files of point clouds: generated sweeps in many layouts are read right or refused, real ones are read as before."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.feather as feather
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.formats.clouds import describe_numbers, has_kitti_layout, has_nuscenes_layout, read_pcd
from flcav.dataset.formats.kitti import read_points
from flcav.dataset.formats.nuscenes.files import encode_lidar
from flcav.dataset.formats.opv2v.files import encode_cloud
from flcav.dataset.formats.sweeps import list_sweeps, read_cloud_file

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[3].parent / "shared" / "data"))
Points = NDArray[np.float32]


def sweep(seed: int, count: int, reach_m: float, height_m: float, order: str, empty: float) -> Points:
    """Return (N, 4) x, y, z [m], intensity of a spinning LiDAR above flat ground between walls."""
    rng = np.random.default_rng(seed)
    channels = 32 if count > 400 else 4
    elevation = np.radians(np.linspace(-25, 3, channels))
    azimuth = np.linspace(-np.pi, np.pi, -(-count // channels), endpoint=False) + rng.uniform(0, 0.1)
    turn, tilt = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
    wall = reach_m * (0.6 + 0.4 * np.sin(3 * turn + seed) ** 2)
    distance = np.where(tilt < 0, np.minimum(height_m / np.maximum(np.sin(-tilt), 1e-6), wall), wall)
    distance = np.maximum(distance + rng.normal(0, 0.02, len(turn)), 1.05)
    points = np.column_stack(
        (
            distance * np.cos(tilt) * np.cos(turn),
            distance * np.cos(tilt) * np.sin(turn),
            distance * np.sin(tilt),
            rng.beta(1, 4, len(turn)),
        )
    )
    rows = {
        "columns": np.arange(len(turn)),
        "rings": np.lexsort((turn, tilt)),
        "shuffled": rng.permutation(len(turn)),
        "interleaved": np.lexsort(
            (np.argsort(np.argsort(elevation) * 7919 % channels)[np.arange(len(turn)) % channels], turn)
        ),
    }[order][:count]
    points = points[rows].astype(np.float32)
    points[rng.random(len(points)) < empty] = 0  # no return
    points[0] = reach_m, 0.5, 1.5, 0.3
    return points


def _padded(points: Points, *more: NDArray) -> bytes:
    return np.column_stack((points, *more)).astype("<f4").tobytes()


def _normals(points: Points) -> NDArray:
    normal = np.random.default_rng(len(points)).normal(size=(len(points), 3))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _ring(points: Points) -> NDArray:
    return np.arange(len(points)) % 32


OTHERS: dict[str, Callable[[Points], bytes]] = {
    "x y z": lambda points: points[:, :3].astype("<f4").tobytes(),
    "x y z, normalised": lambda points: (points[:, :3] / np.abs(points[:, :3]).max()).astype("<f4").tobytes(),
    "intensity to 255": lambda points: (points * np.array([1, 1, 1, 255], np.float32)).astype("<f4").tobytes(),
    "ring, KITTI's axes": lambda points: _padded(points, _ring(points)),
    "time": lambda points: _padded(points, np.linspace(-0.1, 0, len(points))),
    "ring and time": lambda points: _padded(points, _ring(points), np.linspace(0, 0.1, len(points))),
    "normals": lambda points: _padded(points, _normals(points)),
    "normals and curvature": lambda points: _padded(points, _normals(points), np.full(len(points), 0.1)),
    "padded": lambda points: _padded(points[:, :3], np.ones(len(points)), points[:, 3], np.zeros((len(points), 3))),
    "float64": lambda points: points.astype("<f8").tobytes(),
    "float64, rounded": lambda points: np.round(points.astype("<f8"), 3).tobytes(),
    "float64, x y z": lambda points: points[:, :3].astype("<f8").tobytes(),
    "float64, ring": lambda points: np.column_stack((points, _ring(points))).astype("<f8").tobytes(),
    "big-endian": lambda points: points.astype(">f4").tobytes(),
    "float16": lambda points: points.astype("<f2").tobytes(),
    "millimetres": lambda points: (points * 1000).astype("<i4").tobytes(),
    "centimetres": lambda points: np.clip(points * 100, -32768, 32767).astype("<i2").tobytes(),
    "far from the LiDAR": lambda points: (
        (points + np.array([691_000, 5_335_000, 500, 0], np.float32)).astype("<f4").tobytes()
    ),
}
SWEEPS = st.builds(
    sweep,
    seed=st.integers(0, 2**16),
    count=st.integers(100, 3000),
    reach_m=st.sampled_from((4.0, 30.0, 120.0, 400.0)),
    height_m=st.sampled_from((0.3, 1.7, 6.0)),
    order=st.sampled_from(("columns", "rings", "shuffled", "interleaved")),
    empty=st.sampled_from((0.0, 0.5)),
)
MANY = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@given(points=SWEEPS)
@MANY
def test_known_layouts_are_read(tmp_path: Path, points: Points) -> None:
    path = tmp_path / "cloud.bin"
    path.write_bytes(points.tobytes())
    np.testing.assert_array_equal(read_cloud_file(path), points)
    path.write_bytes(encode_lidar(points, np.radians(np.linspace(-25, 3, 32))))
    np.testing.assert_allclose(read_cloud_file(path), points, atol=1e-6)


@pytest.mark.parametrize("layout", OTHERS)
@given(points=SWEEPS)
@example(points=sweep(41749, 101, 4.0, 0.3, "columns", 0.5))  # of float16, no point is high
@settings(MANY, max_examples=20)
def test_other_layouts_are_refused(tmp_path: Path, layout: str, points: Points) -> None:
    path = tmp_path / "cloud.bin"
    data = OTHERS[layout](points)
    for _ in range(4):  # a size that is whole points of KITTI's and of nuScenes'
        points = np.concatenate((points, points[:1]))
        path.write_bytes(data := OTHERS[layout](points))
        with pytest.raises(InputError):
            read_cloud_file(path)
        with pytest.raises(InputError):
            read_points(path)
    assert not has_kitti_layout(data)


@given(rows=st.lists(st.tuples(*[st.floats(-80, 80, width=32)] * 3, st.floats(0, 1, width=32)), min_size=1, max_size=6))
@MANY
@example(rows=[(10.0, 0.0, 0.0, 0.0)])
@example(rows=[(5.0, 1.0, 1.0, 1.0)] * 5)
def test_a_few_points_are_a_cloud(tmp_path: Path, rows: list[tuple[float, ...]]) -> None:
    points = np.array([*rows, (20.0, -3.0, -1.5, 0.25)], "<f4")
    points[np.abs(points) < 1e-20] = 0  # no distance that a LiDAR measures
    (tmp_path / "cloud.bin").write_bytes(points.tobytes())
    np.testing.assert_array_equal(read_cloud_file(tmp_path / "cloud.bin"), points)


def test_points_of_one_object_are_a_cloud(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform((18, 0.1, -1.5, 0), (22, 0.9, 0, 1), (200, 4)).astype("<f4")
    (tmp_path / "cloud.bin").write_bytes(points.tobytes())
    np.testing.assert_array_equal(read_cloud_file(tmp_path / "cloud.bin"), points)


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        ("x y z", "3 columns of float32"),
        ("ring, KITTI's axes", "5 columns of float32"),
        ("normals", "7 columns of float32"),
        ("float64", "4 columns of float64"),
        ("float64, x y z", "3 columns of float64"),
        ("big-endian", "4 columns of big-endian float32"),
        ("intensity to 255", "4 columns of float32"),
        ("millimetres", ""),
    ],
)
@pytest.mark.parametrize("order", ["columns", "rings", "shuffled"])
def test_numbers_tell_their_layout(layout: str, said: str, order: str) -> None:
    assert describe_numbers(OTHERS[layout](sweep(1, 2000, 60.0, 1.7, order, 0.0))) == said


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\x93NUMPY\x01\x00" + bytes(120), "a NumPy array"),
        (b"ply\nformat ascii 1.0\n", "a PLY file"),
        (bytes(160), "no point cloud by its numbers"),
        (np.array([[9, 0, 0, 0], [9, 0, 0, 1.5]], np.float32).tobytes(), "point 1 has an intensity outside 0 to 1"),
        (np.array([[9, 0, 0, 0], [9, 0, 0, -0.1]], np.float32).tobytes(), "point 1 has an intensity outside 0 to 1"),
        (np.array([[9, 0, 0, 0], [9, np.nan, 0, 0]], np.float32).tobytes(), "point 1 is not finite"),
    ],
)
def test_what_is_no_point_cloud_is_refused(tmp_path: Path, data: bytes, said: str) -> None:
    (tmp_path / "cloud.bin").write_bytes(data)
    with pytest.raises(InputError, match=said):
        read_cloud_file(tmp_path / "cloud.bin")


def write_ascii(path: Path, points: NDArray, fields: str = "x y z intensity", data: str = "ascii") -> None:
    count = len(fields.split())
    ones = " ".join("1" * count)
    path.write_text(
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {' '.join('4' * count)}\nTYPE {' '.join('F' * count)}\n"
        f"COUNT {ones}\nWIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA {data}\n"
        + "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in points.tolist())
    )


def test_a_pcd_file_is_read_as_text(tmp_path: Path) -> None:
    points = sweep(0, 200, 60.0, 1.7, "columns", 0.0)
    write_ascii(tmp_path / "cloud.pcd", points)
    np.testing.assert_array_equal(read_cloud_file(tmp_path / "cloud.pcd"), points)
    (tmp_path / "binary.pcd").write_bytes(encode_cloud(points))
    coloured = read_pcd(tmp_path / "binary.pcd")
    write_ascii(tmp_path / "colour.pcd", np.array(coloured.tolist()), "x y z rgb")
    np.testing.assert_array_equal(read_pcd(tmp_path / "colour.pcd"), coloured)
    assert [file.name for file in list_sweeps(tmp_path)] == ["binary.pcd", "cloud.pcd", "colour.pcd"]


@pytest.mark.parametrize(
    ("fields", "data", "scale", "said"),
    [
        ("x y z rgb", "ascii", 1.0, "a PCD file without intensity"),
        ("x y z intensity", "binary_compressed", 1.0, "a compressed PCD file"),
        ("x y z intensity", "ascii", 255.0, "an intensity outside 0 to 1"),
        ("x y z", "ascii", 1.0, "not a binary PCD file"),
        ("x y z intensity", "zipped", 1.0, "not a binary PCD file"),
    ],
)
def test_other_pcd_files_are_refused(tmp_path: Path, fields: str, data: str, scale: float, said: str) -> None:
    points = sweep(0, 50, 60.0, 1.7, "columns", 0.0) * np.array([1, 1, 1, scale], np.float32)
    write_ascii(tmp_path / "cloud.pcd", points, fields, data)
    with pytest.raises(InputError, match=said):
        read_cloud_file(tmp_path / "cloud.pcd")
    path = tmp_path / "cut.pcd"
    write_ascii(path, points)
    path.write_text(path.read_text().rpartition("\n")[0].rpartition("\n")[0])
    with pytest.raises(InputError, match="truncated; it holds 49 of 50 points"):
        read_cloud_file(path)


def test_times_beside_points_are_no_cloud(tmp_path: Path) -> None:
    for name in ("a.bin", "a.times.bin", "b.txt"):
        (tmp_path / name).touch()
    assert [file.name for file in list_sweeps(tmp_path)] == ["a.bin"]


def test_sweeps_of_argoverse_are_told_by_their_numbers(tmp_path: Path) -> None:
    files = sorted((REAL / "argoverse2").rglob("lidar/*.feather"))
    if not files:
        pytest.skip(f"{REAL} has no logs of Argoverse 2: they are not part of the project")
    for path in files:
        table = feather.read_table(path)
        x, y, z, intensity = (table[name].to_numpy().astype(np.float32) for name in ("x", "y", "z", "intensity"))
        points = np.column_stack((x, y, z, intensity / np.float32(255)))
        (tmp_path / "cloud.bin").write_bytes(points.tobytes())
        np.testing.assert_array_equal(read_cloud_file(tmp_path / "cloud.bin"), points)
        (tmp_path / "cloud.bin").write_bytes(np.column_stack((-y, x, z, intensity, intensity % 32)).tobytes())
        np.testing.assert_array_equal(read_cloud_file(tmp_path / "cloud.bin"), points)


def test_real_sweeps_are_read_as_they_are() -> None:
    files = [file for part in ("real", "kitti_frame") for file in sorted((REAL / part).rglob("velodyne/*.bin"))]
    if not files:
        pytest.skip(f"{REAL} has no KITTI frames: they are not part of the project")
    for path in files:
        data = path.read_bytes()
        assert not has_nuscenes_layout(data)
        assert read_cloud_file(path).tobytes() == data, path


@pytest.mark.parametrize("encode", [lambda p: p.tobytes(), lambda p: encode_lidar(p, np.zeros(0))])
def test_millimetres_are_named(encode: Callable[[Points], bytes], tmp_path: Path):
    points = sweep(3, 4000, 60.0, 1.7, "rings", 0.0)
    (tmp_path / "a.bin").write_bytes(encode((points * (1000, 1000, 1000, 1)).astype("<f4")))
    with pytest.raises(
        InputError, match=r"a\.bin: coordinates up to \d+, millimetres by their size; wanted are metres"
    ):
        read_cloud_file(tmp_path / "a.bin")
