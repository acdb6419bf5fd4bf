"""Where things lie in a dataset folder, and its manifest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from flcav.config import InputError, read_json, tell
from flcav.files import Json

FORMAT = 2
MANIFEST = "manifest.json"  # written last: a folder without it is unfinished
CALIBRATION = "calibration.json"  # see `flcav.dataset.calibration`
FILES = "files"  # table of the payload files: all that is neither a table, the calibration nor the manifest
TRACES = "traces"
TOWN = "town"  # holds the folder of a town that does not come with flcav
WORK = ".recording"  # what a recording under way keeps; gone when it is done
PACKAGES = ("flcav", "embreex", "libsumo", "numba", "numpy", "pillow", "pyarrow")  # those that decide the bytes


class Strict(BaseModel):
    """Base of what must be in a manifest; nothing is taken for something else, and more may be there."""

    model_config = ConfigDict(strict=True, extra="allow")


class TableFile(Strict):
    """A table's file."""

    bytes: int
    sha256: str


class Counts(Strict):
    """How much a dataset holds."""

    frames: int
    scenes: int
    annotations: int
    points: int
    images: int
    payload_bytes: int


class Manifest(Strict):
    """What every manifest holds."""

    format: int
    recipe: Mapping[str, Json]
    versions: dict[str, str]
    counts: Counts
    scenes: list[str]
    tables: dict[str, TableFile]


@dataclass(frozen=True)
class FrameKey:
    """Which frame."""

    scene: str
    index: int  # spin number within the scene
    agent: str
    time_s: float


def table_path(name: str) -> str:
    """Return the file of the table `name`."""
    return f"{name}.parquet"


def payload_path(sensor: str, key: str, suffix: str) -> str:
    """Return the file of what `sensor` measured in the frame `key`, in an encoding of `flcav.dataset.payloads`."""
    return f"{sensor}/{key}.{suffix}"


def trace_path(scene: str) -> str:
    """Return the file of a scene's traffic."""
    return f"{TRACES}/{scene}.parquet"


def package_versions(names: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Return the versions of packages, by default of those that decide what is recorded."""
    return {name: version(name) for name in names}


def town_path(town: str) -> str:
    """Return the folder of a town that the dataset brings with it."""
    return f"{TOWN}/{town}"


def read_manifest(folder: Path) -> Manifest:
    """Return a dataset's manifest; raises `InputError` where the folder holds no finished dataset of this format."""
    path = folder / MANIFEST
    if not folder.is_dir():
        raise InputError(f"{folder}: no such dataset folder")
    if not path.is_file():
        reason = "an unfinished recording; record it again to finish it" if (folder / WORK).exists() else "no dataset"
        raise InputError(f"{path}: missing, so {folder} is {reason}")
    manifest = read_json(path)
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if isinstance(found, int) and found != FORMAT:
        advice = "update flcav to read it" if found > FORMAT else "record it again from its recipe"
        raise InputError(f"{path}: dataset format {found}, this version of flcav reads format {FORMAT}; {advice}")
    try:
        return Manifest.model_validate(manifest)
    except ValidationError as error:
        raise InputError(f"{path}: not a dataset manifest: {tell(error, Manifest)}") from None
