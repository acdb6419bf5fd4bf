"""The layout of a dataset folder: the paths of its files, and its manifest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from flcav.config import InputError, Json, describe_error, read_json

FORMAT = 3  # of datasets with tilted boxes, in the table `tilts`
LEVEL_FORMAT = 2  # of all other datasets
MANIFEST = "manifest.json"  # written last: a folder without it is unfinished
CALIBRATION = "calibration.json"  # see `flcav.dataset.calibration`
FILES = "files"  # the table that lists all other files: payloads, traffic, the town's files
TRACES = "traces"
NAVIGATION = "navigation"
TOWN = "town"  # contains the folder of a town that does not come with flcav
WORK = ".recording"  # folder of an unfinished recording; removed at its end
PACKAGES = ("flcav", "embreex", "libsumo", "numba", "numpy", "pillow", "pyarrow")  # those that determine the bytes


class StrictModel(BaseModel):
    """Base class of the records of a manifest: types are not coerced, and additional fields are allowed."""

    model_config = ConfigDict(strict=True, extra="allow")


class TableFile(StrictModel):
    """Size [bytes] and SHA-256 checksum of a file that the manifest lists."""

    bytes: int
    sha256: str


class DatasetCounts(StrictModel):
    """Counts of the contents of a dataset."""

    frames: int
    scenes: int
    annotations: int
    points: int
    images: int
    payload_bytes: int


class Manifest(StrictModel):
    """The manifest of a dataset: format version, resolved recipe, package versions, counts, scenes, table files."""

    format: int
    recipe: Mapping[str, Json]
    versions: dict[str, str]
    counts: DatasetCounts
    scenes: list[str]
    tables: dict[str, TableFile]

    @property
    def imported(self) -> str | None:
        """Return the format that the dataset was imported from, None if flcav recorded it."""
        name = self.recipe.get("imported")
        return name if isinstance(name, str) else None

    @property
    def split_of(self) -> dict[str, str]:
        """Return the splits of an imported dataset's scenes, by scene; scenes without a split are left out."""
        splits = self.recipe.get("splits")
        return {
            str(scene): split
            for split, scenes in (splits.items() if isinstance(splits, Mapping) else ())
            for scene in (scenes if isinstance(scenes, list | tuple) else ())
        }

    @property
    def labels(self) -> Sequence[Json]:
        """Return what is labelled: for a recording "objects" and "signs", unless its recipe says `labels`."""
        labels = self.recipe.get("labels", () if self.imported else ("objects", "signs"))
        return labels if isinstance(labels, list | tuple) else ()


@dataclass(frozen=True)
class FrameKey:
    """The identity of a frame: scene, spin and agent, with its time."""

    scene: str
    index: int  # spin number within the scene
    agent: str
    time_s: float  # of the spin, in the scene [s]


def table_path(name: str) -> str:
    """Return the path of the table `name`, relative to the dataset folder."""
    return f"{name}.parquet"


def payload_path(sensor: str, key: str, suffix: str) -> str:
    """Return the path, relative to the dataset folder, of a measurement of `sensor` in the frame `key`.

    `suffix` is that of its encoding, see `flcav.dataset.payloads`.
    """
    return f"{sensor}/{key}.{suffix}"


def trace_path(scene: str) -> str:
    """Return the path of a scene's traffic, relative to the dataset folder."""
    return f"{TRACES}/{scene}.parquet"


def navigation_path(scene: str) -> str:
    """Return the path of the navigation logs of a scene's vehicles, relative to the dataset folder."""
    return f"{NAVIGATION}/{scene}.parquet"


def package_versions(names: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Return the installed versions of packages, by name; by default of those that determine the recorded bytes."""
    return {name: version(name) for name in names}


def town_path(town: str) -> str:
    """Return the path, relative to the dataset folder, of the folder of a town that is copied into the dataset."""
    return f"{TOWN}/{town}"


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of the dataset in `folder`.

    Raises `InputError` where the folder is missing, or holds no finished dataset or one of another format version.
    """
    path = folder / MANIFEST
    if folder.is_file():
        raise InputError(f"{folder}: is a file, and a dataset is a folder; `flcav record RECIPE --out DIR` makes one")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such dataset folder")
    if not path.is_file():
        reason = "an unfinished recording; record it again to finish it" if (folder / WORK).exists() else "no dataset"
        raise InputError(f"{path}: missing, so {folder} is {reason}")
    manifest = read_json(path)
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if isinstance(found, int) and found not in (LEVEL_FORMAT, FORMAT):
        advice = "update flcav to read it" if found > FORMAT else "record it again from its recipe"
        raise InputError(
            f"{path}: dataset format {found}, this version of flcav reads formats {LEVEL_FORMAT} and {FORMAT}; {advice}"
        )
    try:
        return Manifest.model_validate(manifest)
    except ValidationError as error:
        raise InputError(f"{path}: not a dataset manifest: {describe_error(error, Manifest)}") from None
