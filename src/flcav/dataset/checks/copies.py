"""Copies of recordings in several splits, by the checksums of their point clouds.

No two spins of a LiDAR are equal to the bit, so a cloud that is there twice is one recording, however its scenes are
called.
"""

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from flcav.config import InputError
from flcav.dataset.layout import FILES, payload_path, read_manifest, table_path
from flcav.dataset.payloads import POINTS
from flcav.dataset.tables import read_table


class CloudPlace(NamedTuple):
    """A point cloud's place: its dataset, the scene and the split of that; the split is empty where it has none."""

    folder: Path
    split: str
    scene: str


def find_copies(folders: Sequence[Path]) -> list[str]:
    """Return a sentence for each two splits, of one dataset or of two, in which the same point clouds are.

    Folders that hold no whole dataset are left out: `validate` says what they lack.
    """
    first: dict[str, CloudPlace] = {}  # by checksum
    shared: dict[tuple[tuple[Path, str], tuple[Path, str]], list[tuple[str, str]]] = defaultdict(list)
    for folder in folders:
        with contextlib.suppress(InputError):
            for digest, cloud in _list_clouds(folder):
                one = first.setdefault(digest, cloud)
                if one.split != cloud.split and one.scene != cloud.scene:  # else the name says it
                    shared[one[:2], cloud[:2]].append((one.scene, cloud.scene))
    return [
        f"{one} (split '{split}') and {other} (split '{other_split}'): leakage, they share {len(scenes)} point clouds, "
        f"the first is of the scenes '{scenes[0][0]}' and '{scenes[0][1]}'"
        for ((one, split), (other, other_split)), scenes in shared.items()
    ]


def _list_clouds(folder: Path) -> Iterator[tuple[str, CloudPlace]]:
    """Yield checksum and place of the point clouds of a dataset, without the empty ones."""
    manifest = read_manifest(folder)
    split_of, own = manifest.split_of, str(manifest.recipe.get("split", ""))
    frames = read_table(folder / table_path("frames"), "frames").select(["key", "scene", "lidar"]).to_pylist()
    files = read_table(folder / table_path(FILES), FILES).to_pydict()
    digests = {path: digest for path, size, digest in zip(files["path"], files["bytes"], files["sha256"]) if size}
    for row in frames:
        for lidar in row["lidar"]:
            if digest := digests.get(payload_path(lidar, row["key"], POINTS)):
                yield digest, CloudPlace(folder, split_of.get(row["scene"], own), row["scene"])
