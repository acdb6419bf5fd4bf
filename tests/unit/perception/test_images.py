"""Pictures that a user names: what is taken, and one sentence for what is not."""

import io

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from flcav.config import InputError
from flcav.dataset.formats.kitti.files import _read_image
from flcav.dataset.formats.reading import measure_picture
from flcav.dataset.payloads import read_image
from flcav.network.ledger import from_names
from flcav.perception.images import (
    check_picture,
    read_picture,
    read_pictures,
    recoloured,
    resize_picture,
    unpack_pictures,
)

RANDOM = np.random.default_rng(0)
RGB = RANDOM.integers(0, 256, (40, 60, 3), dtype=np.uint8)


def saved(path, pixels, **options):
    Image.fromarray(pixels).save(path, **options)
    return path


def test_files_and_folders(tmp_path):
    for name in ("b.png", "a.webp"):
        saved(tmp_path / name, RGB, lossless=True)
    saved(tmp_path / "c.JPG", RGB, format="jpeg", quality=95)
    (tmp_path / "notes.txt").write_text("no picture")
    seen = list(read_pictures(tmp_path))
    assert [path.name for path, _ in seen] == ["a.webp", "b.png", "c.JPG"]
    assert all(np.array_equal(picture, RGB) for _, picture in seen[:2])
    ((path, picture),) = read_pictures(tmp_path / "b.png")
    assert path == tmp_path / "b.png"
    assert np.array_equal(picture, RGB)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_reader_takes_a_picture_upright(suffix, orientation, tmp_path):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    path = saved(tmp_path / f"phone.{suffix}", RGB, exif=exif)
    with Image.open(path) as image:
        upright = np.asarray(ImageOps.exif_transpose(image))
    assert upright.shape == ((40, 60, 3) if orientation < 5 else (60, 40, 3))
    message = {"cameras": from_names(["front"]), "picture.front": np.frombuffer(path.read_bytes(), np.uint8)}
    for found in (
        read_picture(path),
        next(read_pictures(tmp_path))[1],
        read_image(path, np.uint8, channels=3),
        _read_image(path),
        unpack_pictures(message)["front"],
    ):
        assert np.array_equal(found, upright)
    assert measure_picture(path) == upright.shape[1::-1]


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
@pytest.mark.parametrize("exif", [b"Exif\0\0not a TIFF", b"Exif\0\0II*\0\xff\xff\xff\xff", b"Exif\0\0"])
def test_damaged_exif_leaves_a_picture_as_it_is(exif, tmp_path):
    path = saved(tmp_path / "phone.png", RGB, exif=exif)
    assert np.array_equal(read_picture(path), RGB)
    assert measure_picture(path) == (60, 40)


@pytest.mark.parametrize(
    ("pixels", "said"),
    [
        (RGB[..., 0], r"1 channels \(L\); 3 are wanted"),
        (np.dstack((RGB, RGB[..., :1])), r"4 channels \(RGBA\)"),
        (RGB[:31], "60 x 31 pixels; sides of 32 to 8192"),
        (np.zeros((32, 8193, 3), np.uint8), "8193 x 32 pixels"),
    ],
)
def test_other_channels_and_sizes(pixels, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read_picture(saved(tmp_path / "odd.png", pixels))


def test_what_is_no_picture(tmp_path):
    whole = io.BytesIO()
    Image.fromarray(RGB).save(whole, "png")
    (tmp_path / "cut.png").write_bytes(whole.getvalue()[: len(whole.getvalue()) // 2])
    (tmp_path / "text.png").write_text("no picture")
    for name in ("cut.png", "text.png"):
        with pytest.raises(InputError, match=f"{name}: not a picture, or a damaged one"):
            read_picture(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        list(read_pictures(tmp_path / "none.png"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="neither a dataset nor a folder"):
        list(read_pictures(tmp_path / "empty"))
    with pytest.raises(InputError, match="shape"):
        check_picture(RGB[..., 0], "here")


def test_shrinking_averages():
    board = np.indices((64, 64)).sum(0) % 2 * np.uint8(255)
    small = resize_picture(np.dstack([board.astype(np.uint8)] * 3), 32, 32)
    assert np.abs(small.astype(int) - 127).max() <= 8


def test_colours_go_away_from_grey_and_get_brighter():
    grey = np.full((4, 4, 3), 100, np.uint8)
    assert (recoloured(grey, 1.5, 0.2) == 150).all()
    assert (recoloured(grey, 3.0, 1.0) == 255).all()
    red = np.full((4, 4, 3), (200, 50, 50), np.uint8)
    assert np.array_equal(recoloured(red, 1.0, 1.0), red)
    spread = [float(np.ptp(recoloured(red, 1.0, by)[0, 0])) for by in (0.5, 1.0, 1.3)]
    assert spread == pytest.approx([75, 150, 195], abs=1)
