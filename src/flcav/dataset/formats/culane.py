"""Export to CULane: pictures, `.lines.txt` beside each, label images in `laneseg_label_w16`, and lists in `list`.

CULane has at most four lane lines a picture, numbered from left to right: 2 and 3 border the camera's lane, 1 and 4 lie
next to them (Pan et al., "Spatial As Deep: Spatial CNN for Traffic Scene Understanding", AAAI 2018;
https://xingangpan.github.io/projects/CULane.html). A row of a `.lines.txt` is a line from its near end to its far end,
x and y in turn [px], at rows `ROWS_PX` apart. In a label image its pixels have its number; lines are there 16 pixels
wide in CULane's pictures of 1640, and as much of the width here.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from flcav.arrays import Array, Bytes
from flcav.dataset.formats.writing import (
    Exported,
    ExportFormat,
    ExportOptions,
    LeftOut,
    count_unwritten,
    missing_data_error,
    split_with_validation,
    write_file,
)
from flcav.dataset.payloads import encode_png
from flcav.dataset.road_labels import check_road_labels, label_road
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report
from flcav.storage.files import atomic_path

LABELS = "laneseg_label_w16"  # folder of the label images
NUMBERS = (1, 2, 3, 4)
ROWS_PX = 10  # distance of the points of a line
WIDTH_SHARE = 16 / 1640  # of a line in a label image
QUALITY = 95  # of the JPEG files
FURTHER = LeftOut("lane lines", "CULane has two to the left of the camera and two to the right")


def export_culane(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write every image of `dataset` with its lane lines: see `ExportFormat`."""
    pictures = [(i, camera) for i in range(len(dataset)) for camera in dataset.cameras(i)]
    if not pictures:
        raise missing_data_error(dataset, "CULane", "camera images")
    split_of = split_with_validation(dataset, options, "CULane")
    check_road_labels(dataset)
    exported = Exported(Counter({"images": 0, "lane lines": 0}))
    rows: dict[str, list[str]] = {}
    for done, (i, camera) in enumerate(pictures, start=1):
        frame, rgb = dataset.frame(i), dataset.plane(i, camera, "rgb")
        lines = [line.pixels for line in label_road(dataset, i, camera).lines]
        height, width = rgb.shape[:2]
        numbered = number_lines(lines, width, height)
        exported.left_out[FURTHER] += len(lines) - len(numbered)
        exported.counts.update({"images": 1, "lane lines": len(numbered)})
        path = f"{frame.scene}/{frame.key}_{camera}"
        _write_picture(out / f"{path}.jpg", rgb)
        write_file(out / f"{path}.lines.txt", "".join(_row(line) for _, line in sorted(numbered.items())))
        write_file(out / LABELS / f"{path}.png", encode_png(_label(numbered, width, height)))
        there = " ".join(str(int(number in numbered)) for number in NUMBERS)
        split = split_of[frame.scene]
        rows.setdefault(f"{split}.txt", []).append(f"/{path}.jpg")
        rows.setdefault(f"{split}_gt.txt", []).append(f"/{path}.jpg /{LABELS}/{path}.png {there}")
        if frame.weather is not None:
            light = "test8_night" if frame.weather.night else "test0_normal"
            rows.setdefault(f"test_split/{light}.txt", []).extend([f"{path}.jpg"] if split == "test" else [])
        progress(done, len(pictures), "")
    for i in range(len(dataset)):
        frame = dataset.frame(i)
        exported.left_out.update(count_unwritten("CULane", frame, frame.images))
    for name, listed in rows.items():
        if listed:
            write_file(out / "list" / name, "".join(f"{row}\n" for row in listed))
    return exported


EXPORT = ExportFormat(export_culane, ("validation",))


def number_lines(lines: Sequence[Array], width: int, height: int) -> dict[int, Array]:
    """Return the lines (K, 2) [px] by CULane's number: the two next to the picture's middle on either side.

    They are ordered by where they meet the lower edge of the picture, prolonged from their near end.
    """
    met = [(_meet_edge(line, height - 1) - (width - 1) / 2, line) for line in lines]
    left = sorted((place for place in met if place[0] < 0), key=lambda place: -place[0])
    right = sorted((place for place in met if place[0] >= 0), key=lambda place: place[0])
    return {number: line for number, (_, line) in [*zip((2, 1), left), *zip((3, 4), right)]}


def _meet_edge(line: Array, row: float) -> float:
    """Return the column [px] where a line, prolonged straight from its near end, meets a row."""
    u, v = line.T
    far = int(np.argmax(v <= v[0] - min(ROWS_PX, np.ptp(v))))
    return float(u[0] + (row - v[0]) * (u[far] - u[0]) / (v[far] - v[0]))


def _row(line: Array) -> str:
    """Return a line's row: its points at rows of whole multiples of `ROWS_PX`, from near to far."""
    rising = np.flatnonzero(np.concatenate(([True], np.diff(np.minimum.accumulate(line[:, 1])) < 0)))
    u, v = line[rising].T
    rows = np.arange(np.ceil(v[-1] / ROWS_PX), np.floor(v[0] / ROWS_PX) + 1)[::-1] * ROWS_PX
    columns = np.interp(-rows, -v, u)
    return " ".join(f"{x:.3f} {y:.0f}" for x, y in zip(columns, rows, strict=True)) + "\n"


def _label(numbered: dict[int, Array], width: int, height: int) -> Bytes:
    image = Image.new("L", (width, height))
    draw = ImageDraw.Draw(image)
    for number, line in sorted(numbered.items()):
        draw.line(
            [tuple(point) for point in line.tolist()], fill=number, width=round(WIDTH_SHARE * width), joint="curve"
        )
    return np.asarray(image)


def _write_picture(path: Path, rgb: Bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        Image.fromarray(rgb).save(temporary, format="JPEG", quality=QUALITY)
