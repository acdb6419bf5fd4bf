"""Compressed sweeps: what comes back, and how few bytes a return takes."""

import lzma
import os
from pathlib import Path

import numpy as np
import pytest

from flcav.geometry import Boxes
from flcav.network.ledger import pack_arrays, unpack_arrays
from flcav.perception.objects.samples import compress_sample, pack_boxes, unpack_boxes
from flcav.sensors.lidar import compression
from flcav.sensors.lidar.compression import CODED, RETURN_BYTES, decode_sweep, encode_sweep

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4] / "shared" / "data"))
KITTI = REAL / "kitti_frame" / "training" / "velodyne" / "000008.bin"
HALF = np.array((0.005, 0.005, 0.005, 0.5 / 255)) * 1.001  # half a level, and the rounding of single precision


def make_sweep(channels: int = 32, steps: int = 900) -> np.ndarray:
    """Return the returns of a spinning LiDAR 1.8 m above a plane within walls, with errors of 2 cm in range."""
    rng = np.random.default_rng(0)
    down, azimuth = np.radians(np.linspace(2, -25, channels)), np.linspace(0, 2 * np.pi, steps, endpoint=False)
    unit = np.stack(
        (
            np.outer(np.cos(down), np.cos(azimuth)),
            np.outer(np.cos(down), np.sin(azimuth)),
            np.outer(np.sin(down), np.ones(steps)),
        ),
        axis=-1,
    ).reshape(-1, 3)
    far = np.minimum(40.0, 1.8 / np.maximum(-unit[:, 2], 1e-3)) + rng.normal(0, 0.02, len(unit))
    intensity = np.clip(rng.normal(0.3, 0.02, len(unit)), 0, 1)
    return np.column_stack((unit * far[:, None], intensity)).astype(np.float32)


@pytest.mark.parametrize(
    "points",
    [
        make_sweep(),
        make_sweep()[::-1][:1],
        np.zeros((0, 4), np.float32),
        np.array([[-1e5, 1e5, 0, 0], [1e5, -1e5, -0.004, 1]], np.float32),
        np.random.default_rng(1).uniform((-300, -300, -9, 0), (300, 300, 40, 1), (500, 4)).astype(np.float32),
    ],
    ids=["sweep", "one", "none", "far", "scattered"],
)
def test_returns_come_back_in_their_order_to_half_a_centimetre(points: np.ndarray) -> None:
    found = decode_sweep(encode_sweep(points))
    assert (found.dtype, found.shape) == (np.float32, points.shape)
    assert (np.abs(found.astype(float) - points) <= HALF + np.abs(points) * 1e-7).all()
    np.testing.assert_array_equal(decode_sweep(encode_sweep(found)), found)  # levels stay levels


def test_a_return_takes_a_sixth_of_its_floats() -> None:
    points = make_sweep()
    assert len(encode_sweep(points)) < points.nbytes / 6


@pytest.mark.skipif(not KITTI.is_file(), reason=f"no sweep of KITTI at {KITTI}; set FLCAV_REAL_DATA")
def test_a_return_of_kitti_takes_two_bytes_and_a_quarter() -> None:
    points = np.fromfile(KITTI, np.float32).reshape(-1, 4)
    assert len(encode_sweep(points)) / len(points) < 2.25
    assert (np.abs(decode_sweep(encode_sweep(points)) - points) <= HALF).all()


def test_a_compressed_sample_keeps_its_boxes() -> None:
    car = Boxes(np.array([[12.0, 3.0, -1.0]]), np.array([[4.4, 1.8, 1.6]]), np.array([0.3]), np.array(["Car"]))
    whole = pack_arrays({"points": make_sweep(), **pack_boxes(car, "boxes"), **pack_boxes(Boxes.empty(), "ignore")})
    sent = unpack_arrays(compress_sample(whole))
    assert len(compress_sample(whole)) < len(whole) / 5
    np.testing.assert_array_equal(unpack_boxes(sent, "boxes").array(), car.array())
    np.testing.assert_array_equal(decode_sweep(sent["points"]), decode_sweep(encode_sweep(make_sweep())))


@pytest.mark.parametrize("plain", [b"\0" * 17, b"\0" * (RETURN_BYTES * 1001)])
def test_bytes_of_no_sweep_or_of_too_large_a_one_are_refused(plain: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compression, "MOST", 1000)
    with pytest.raises(ValueError, match="not a compressed sweep of at most 1000 returns"):
        decode_sweep(np.frombuffer(lzma.compress(plain, **CODED), np.uint8))
    assert len(decode_sweep(np.frombuffer(lzma.compress(b"\0" * RETURN_BYTES * 1000, **CODED), np.uint8))) == 1000


def test_other_bytes_are_refused() -> None:
    with pytest.raises(ValueError, match="not a compressed sweep"):
        decode_sweep(np.full(100, 255, np.uint8))
