"""Regions of real vehicles: KITTI's drive 0000 and single frames (karlsruhe), and the drive of Astyx HiRes2019 (astyx).

A split of a region is a folder in the layout of KITTI's object benchmark, with the scene, the vehicle and the time of
each sweep in `frames.csv`, and is imported as any other. Its files are links; only KITTI's sweeps are written anew,
since they are cut to `ASIDE_RAD`: what lies beyond has no labels.
"""

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, read_file
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.formats.kitti.files import TRUNCATION, read_lines, read_points
from flcav.dataset.formats.kitti.tracking import SITTING
from flcav.dataset.formats.kitti.write import FRAMES
from flcav.fusion.registration import DrivenSource
from flcav.storage.files import write_bytes

KARLSRUHE, ASTYX = "karlsruhe", "astyx"
EDGE, VALIDATION, TEST = "edge", "validation", "test"
DRIVE, OBJECTS, HIRES = "kitti_tracking_0000", "kitti", "astyx"  # folders of the data
SEQUENCE = "0000"  # of the drive, in KITTI's tracking layout
CHOSE = ("000003", "000009", "000021", "000142", "000217", "001584", "003638", "004240", "006918")  # the detector
WATCHED, LEARNED, FIRST_TESTED = range(100), range(100, 220), 230  # frames of Astyx
VEHICLES = 4  # of a region
ASIDE_RAD = float(np.radians(40.0))  # of KITTI's points from straight ahead, about the image
GAP_S, DRIVE_HZ = 3.0, 10.0  # longest time between sweeps of a scene of Astyx; sweeps of KITTI's drive
Points = NDArray[np.float32]  # (N, 4) x ahead, y left, z up [m], intensity 0 to 1


@dataclass(frozen=True)
class Sweep:
    """A labelled sweep in KITTI's object layout, and where it belongs in its region."""

    number: str  # name of its files, such as "000142"
    points: Path | Points
    calib: Path
    labels: Path | str  # file, or its text
    scene: int = 0  # number of the scene
    index: int = 0  # in the scene
    vehicle: int = 0
    time_s: float = 0.0  # in the scene


def prepare_regions(data: Sequence[Path], out: Path) -> dict[str, dict[str, Path]]:
    """Import the splits of both regions below `out`, unless they are there; return their folders by region and split.

    `data`: folders that hold `kitti_tracking_0000`, `kitti` or `astyx`, see `list_karlsruhe` and `list_astyx`.
    """
    listed = {KARLSRUHE: list_karlsruhe(data), ASTYX: list_astyx(data)}
    for region, splits in listed.items():
        for split, sweeps in splits.items():
            if (out / region / split / "manifest.json").is_file():
                continue
            kitti = out / "kitti" / f"{region}-{split}"
            write_kitti(sweeps, kitti)
            driven = (region, split) == (KARLSRUHE, EDGE)
            if driven:  # odometry gives the drive its poses
                import_dataset("kitti", kitti, out / region / split, posed=DrivenSource)
            else:
                import_dataset("kitti", kitti, out / region / split)
    return {region: {split: out / region / split for split in splits} for region, splits in listed.items()}


def list_karlsruhe(data: Sequence[Path]) -> dict[str, list[Sweep]]:
    """Return the sweeps of `karlsruhe` by split: those of the drive, a stretch per vehicle, and single frames.

    Test frames are those of the first folder of `data` that has some, and all others those of the first that has them.
    """
    frames = list_objects(data, OBJECTS, lambda number: number in CHOSE)
    tested = list_objects(data, OBJECTS, lambda number: number not in CHOSE)
    single = [[_cut(replace(each, scene=i)) for i, each in enumerate(split)] for split in (frames, tested)]
    return {EDGE: list_drive(read_drive(find_folder(data, DRIVE))), VALIDATION: single[0], TEST: single[1]}


def list_astyx(data: Sequence[Path]) -> dict[str, list[Sweep]]:
    """Return the sweeps of `astyx` by split; test frames are chosen as in `list_karlsruhe`."""
    edge = list_objects(data, HIRES, lambda number: int(number) in LEARNED)
    watched = list_objects(data, HIRES, lambda number: int(number) in WATCHED)
    tested = list_objects(data, HIRES, lambda number: int(number) >= FIRST_TESTED)
    return {EDGE: share_scenes(edge, VEHICLES), VALIDATION: watched, TEST: tested}


@dataclass(frozen=True)
class Drive:
    """KITTI's tracking sequence, with sweeps cut to `ASIDE_RAD`."""

    sweeps: Mapping[int, Points]  # by frame, in their order
    labels: Path  # of all frames
    calib: Path


def read_drive(folder: Path) -> Drive:
    """Return the drive in `folder`: in KITTI's tracking layout, or `points.npz`, `label_02.txt` and `calib.txt`."""
    if (folder / "points.npz").is_file():
        sweeps, names = _unpack(folder / "points.npz"), ("label_02.txt", "calib.txt")
    else:
        files = sorted((folder / "training/velodyne" / SEQUENCE).glob("*.bin"))
        sweeps = ((int(path.stem), read_points(path)) for path in files)
        names = (f"training/label_02/{SEQUENCE}.txt", f"training/calib/{SEQUENCE}.txt")
    return Drive({frame: cut_aside(points) for frame, points in sweeps}, *(folder / name for name in names))


def list_drive(drive: Drive) -> list[Sweep]:
    """Return the sweeps of a drive in as many stretches as there are vehicles."""
    texts, frames = convert_labels(read_lines(drive.labels)), np.array([*drive.sweeps])
    return [
        Sweep(f"{n:06d}", drive.sweeps[n], drive.calib, texts.get(n, ""), vehicle, i, vehicle, i / DRIVE_HZ)
        for vehicle, stretch in enumerate(np.array_split(frames, VEHICLES))
        for i, n in enumerate(stretch.tolist())
    ]


def write_tracking(drive: Drive, out: Path) -> None:
    """Write a drive in KITTI's tracking layout to `out`; labels and calibration are links."""
    part = out / "training"
    for kind, path in (("label_02", drive.labels), ("calib", drive.calib)):
        (part / kind).mkdir(parents=True, exist_ok=True)
        (part / kind / f"{SEQUENCE}.txt").unlink(missing_ok=True)
        (part / kind / f"{SEQUENCE}.txt").symlink_to(path.resolve())
    (part / "velodyne" / SEQUENCE).mkdir(parents=True, exist_ok=True)
    for frame, points in drive.sweeps.items():
        write_bytes(part / "velodyne" / SEQUENCE / f"{frame:06d}.bin", points.astype("<f4").tobytes())


def convert_labels(lines: Iterable[str]) -> dict[int, str]:
    """Return the text of label files of KITTI's object benchmark by frame, from the lines of a tracking sequence.

    Lines lose frame and track; levels of truncation become shares.
    """
    texts: dict[int, str] = {}
    for line in lines:
        frame, _, name, truncation, *others = line.split()
        share = TRUNCATION[int(truncation)] if truncation in ("0", "1", "2") else float(truncation)
        row = " ".join((SITTING.get(name, name), f"{share:.2f}", *others))
        texts[int(frame)] = f"{texts.get(int(frame), '')}{row}\n"
    return texts


def share_scenes(sweeps: Sequence[Sweep], vehicles: int) -> list[Sweep]:
    """Return the sweeps with the vehicles that drove them: stretches of whole scenes with about as many sweeps each."""
    shared, before = list[Sweep](), 0
    for _, scene in groupby(sweeps, lambda sweep: sweep.scene):
        part = [*scene]
        vehicle = (2 * before + len(part)) * vehicles // (2 * len(sweeps))  # where the scene's middle lies
        shared += [replace(sweep, vehicle=vehicle) for sweep in part]
        before += len(part)
    return shared


def find_folder(data: Sequence[Path], name: str) -> Path:
    """Return the first folder `name` in those of `data`; raises `InputError` where there is none."""
    for root in data:
        if (root / name).is_dir():
            return root / name
    raise InputError(f"{' and '.join(str(root / name) for root in data)}: no such folder")


def list_objects(data: Sequence[Path], name: str, wanted: Callable[[str], bool]) -> list[Sweep]:
    """Return the wanted sweeps of the first folder `name` that has some, in KITTI's object layout, with their scenes.

    Scenes follow from `timestamps.csv` (frame, lidar_us): a new one begins after more than `GAP_S`. A sweep without a
    time is a scene of its own. Raises `InputError` where no folder has a wanted sweep.
    """
    for folder in (root / name for root in data):
        numbers = sorted(path.stem for path in (folder / "training/velodyne").glob("*.bin") if wanted(path.stem))
        if numbers:
            return [*_place(folder, numbers)]
    raise InputError(f"{' and '.join(str(root / name) for root in data)}: no sweep that is wanted in training/velodyne")


def _place(folder: Path, numbers: Sequence[str]) -> Iterator[Sweep]:
    times = _read_times(folder / "timestamps.csv")
    scene, index, first, last = -1, 0, 0.0, -np.inf
    for number in numbers:
        now = times.get(number, np.nan)
        if not 0 <= now - last <= GAP_S:
            scene, index, first = scene + 1, 0, now
        points, calib, labels = (folder / "training" / kind / f"{number}.{end}" for kind, end in LAYOUT)
        time_s = 0.0 if np.isnan(now) else now - first
        yield Sweep(number, points, calib, labels, scene, index, time_s=time_s)
        index, last = index + 1, now


LAYOUT = (("velodyne", "bin"), ("calib", "txt"), ("label_2", "txt"))


def write_kitti(sweeps: Sequence[Sweep], out: Path) -> None:
    """Write the sweeps in KITTI's object layout to `out`, with `frames.csv`; files are linked to."""
    for kind, _ in LAYOUT:
        (out / "training" / kind).mkdir(parents=True, exist_ok=True)
    rows = ["number,frame,agent,time_s"]
    for sweep in sweeps:
        for (kind, end), content in zip(LAYOUT, (sweep.points, sweep.calib, sweep.labels), strict=True):
            path = out / "training" / kind / f"{sweep.number}.{end}"
            path.unlink(missing_ok=True)
            if isinstance(content, Path):
                path.symlink_to(content.resolve())
            else:
                write_bytes(path, content.encode() if isinstance(content, str) else content.astype("<f4").tobytes())
        agent = f"car{sweep.vehicle}"
        rows.append(f"{sweep.number},stretch{sweep.scene:03d}_{sweep.index:06d}_{agent},{agent},{sweep.time_s:.3f}")
    write_bytes(out / FRAMES, "\n".join((*rows, "")).encode())


def cut_aside(points: Points) -> Points:
    """Return the points (M, 4) at most `ASIDE_RAD` from straight ahead."""
    return points[np.abs(np.arctan2(points[:, 1], points[:, 0])) <= ASIDE_RAD]


def _cut(sweep: Sweep) -> Sweep:
    points = read_points(sweep.points) if isinstance(sweep.points, Path) else sweep.points
    return replace(sweep, points=cut_aside(points))


def _unpack(path: Path) -> Iterator[tuple[int, Points]]:
    """Yield number and points of the sweeps of an archive: centimetres in FRAME_xyz_cm, FRAME_intensity_255."""
    with np.load(path, allow_pickle=False) as archive:
        for number in sorted({name[:6] for name in archive.files}):
            xyz, intensity = archive[f"{number}_xyz_cm"], archive[f"{number}_intensity_255"]
            yield int(number), np.column_stack((xyz / 100, intensity / 255)).astype(np.float32)


def _read_times(path: Path) -> Mapping[str, float]:
    """Return the times [s] by number of the sweep; none without the file."""
    if not path.is_file():
        return {}
    rows = csv.DictReader(read_file(path).decode().splitlines())
    try:
        return {row["frame"]: float(row["lidar_us"]) / 1e6 for row in rows}
    except (KeyError, ValueError, TypeError):
        raise InputError(f"{path}: wanted are the columns frame, lidar_us") from None
