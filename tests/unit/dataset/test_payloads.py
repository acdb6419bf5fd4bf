import io
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from flcav.config import InputError
from flcav.dataset.payloads import (
    check_image,
    encode_depth,
    encode_plane,
    encode_rows,
    read_image,
    read_plane,
    read_rows,
)

PLANES = {
    "rgb": lambda rng: rng.integers(0, 256, (24, 32, 3), dtype=np.uint8),
    "semantic": lambda rng: rng.integers(0, 30, (24, 32), dtype=np.uint8),
    "instance": lambda rng: rng.integers(0, 65_536, (24, 32), dtype=np.uint16),
}


@pytest.mark.parametrize("plane", PLANES)
def test_planes_come_back_as_they_were_and_other_programs_read_them(tmp_path: Path, plane: str):
    pixels = PLANES[plane](np.random.default_rng(0))
    data = encode_plane(plane, pixels)
    (tmp_path / plane).write_bytes(data)
    found = read_plane(tmp_path / plane, plane)
    assert found.dtype == pixels.dtype
    np.testing.assert_array_equal(found, pixels)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), pixels)
    assert encode_plane(plane, pixels) == data


@given(st.lists(st.floats(0.0625, 9e5, width=32), min_size=1, max_size=64))
@settings(max_examples=50, deadline=None)
def test_depth_is_kept_to_a_32768th_of_itself(tmp_path_factory: pytest.TempPathFactory, values: list[float]):
    path = tmp_path_factory.mktemp("depth") / "d"
    depth = np.array([[*values, np.inf]], np.float32)
    path.write_bytes(encode_depth(depth))
    found = read_plane(path, "depth_m")
    assert found.shape == depth.shape
    assert found.dtype == np.float32
    assert found[0, -1] == np.inf
    np.testing.assert_allclose(found[0, :-1], depth[0, :-1], rtol=2.0**-15)


def test_what_is_no_payload_is_named(tmp_path: Path):
    path = tmp_path / "x"
    for plane in ("rgb", "depth_m", "semantic", "instance"):
        with pytest.raises(InputError, match="missing from the dataset"):
            read_plane(path, plane)
    path.write_bytes(b"not an image")
    for plane in ("rgb", "depth_m", "semantic", "instance"):
        with pytest.raises(InputError, match=r"x: not a readable (depth )?image"):
            read_plane(path, plane)
    whole = encode_plane("semantic", np.zeros((20, 20), np.uint8))
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="not a readable image"):
        read_image(path, np.uint8)


def test_an_image_of_other_channels_is_named(tmp_path: Path):
    for plane, pixels in (("rgb", PLANES["semantic"]), ("semantic", PLANES["rgb"]), ("instance", PLANES["rgb"])):
        Image.fromarray(pixels(np.random.default_rng(0))).save(tmp_path / "x", "png")
        with pytest.raises(InputError, match=r"x: not a readable image \(it has \d channels, not \d\)"):
            read_plane(tmp_path / "x", plane)
    (tmp_path / "x").write_bytes(pa.Codec("zstd").compress(b"\x93NUMPY\x01\x00\x0a\x00{'descr':((\n", asbytes=True))
    with pytest.raises(InputError, match="not a readable depth image"):
        read_plane(tmp_path / "x", "depth_m")


def test_rows_are_counted(tmp_path: Path):
    path, rows = tmp_path / "r.radar.bin", np.arange(15, dtype=np.float32).reshape(3, 5)
    path.write_bytes(encode_rows(rows))
    np.testing.assert_array_equal(read_rows(path, "radar.bin", 3), rows)
    with pytest.raises(InputError, match="60 bytes where 4 points take 80"):
        read_rows(path, "radar.bin", 4)


@pytest.mark.parametrize("kind", ["png", "jpeg", "webp"])
def test_a_truncated_image_is_told_by_its_end(kind: str, tmp_path: Path):
    whole, path = io.BytesIO(), tmp_path / f"a.{kind}"
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(whole, kind)
    for more in (b"", b"\0" * 100):
        path.write_bytes(whole.getvalue() + more)
        check_image(path)
    for share in (0.3, 0.7, 0.99):
        path.write_bytes(whole.getvalue()[: int(share * len(whole.getvalue()))])
        with pytest.raises(InputError, match=rf"a.{kind}: a truncated image"):
            check_image(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match="not an image, or a truncated one"):
        check_image(path)


def _write_depth(path: Path, header: dict[str, object], zeros: int) -> Path:
    """Write a depth file whose header may lie, with so many zeros after it."""
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, header)  # type: ignore[arg-type]
    with pa.CompressedOutputStream(pa.OSFile(str(path), "wb"), "zstd") as stream:
        stream.write(data.getvalue())
        for start in range(0, zeros, 1 << 20):
            stream.write(bytes(min(1 << 20, zeros - start)))
    return path


@pytest.mark.parametrize(
    ("shape", "zeros", "sentence"),
    [
        ((4, 24, 32), 1 << 28, "its length is not that of its header"),
        ((4, 24, 32), 3000, "its length is not that of its header"),
        ((4, 10**6, 10**9), 100, "it holds uint8 of shape"),
        ((4, -1, 32), 1 << 28, "it holds uint8 of shape"),
        ((3, 24, 32), 3 * 24 * 32, "it holds uint8 of shape"),
    ],
)
def test_no_more_is_unfolded_of_a_depth_image_than_it_holds(
    tmp_path: Path, shape: tuple[int, ...], zeros: int, sentence: str
):
    header = {"descr": "|u1", "fortran_order": False, "shape": shape}
    path = _write_depth(tmp_path / "d", header, zeros)
    before = pa.total_allocated_bytes()
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=f"not a readable depth image .{sentence}"):
            read_plane(path, "depth_m")
        assert tracemalloc.get_traced_memory()[1] + pa.total_allocated_bytes() - before < 10e6
    finally:
        tracemalloc.stop()


def test_a_picture_larger_than_any_lens_is_not_decoded(tmp_path: Path, recwarn: pytest.WarningsRecorder):
    Image.new("1", (12_000, 9_000)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="a picture of 12000 x 9000 pixels; sides of at most 8192 are wanted"):
        read_image(tmp_path / "a.png", np.uint8)
    assert not recwarn.list
