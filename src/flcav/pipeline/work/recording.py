"""Steps that record the data of a region's splits, or divide recorded ones."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from flcav.config import InputError
from flcav.pipeline.frames import deal_frames, hash_manifest, hash_town, record_frames
from flcav.pipeline.recipe import Role, SplitName
from flcav.pipeline.results import Placed
from flcav.pipeline.steps import Work
from flcav.pipeline.work import Fields


def record_step(work: Work, fields: Fields, beside: str, places: Sequence[str], version: Mapping[str, str]) -> None:
    """Record one split, also from the poles that the steps `places` chose; `version`: SHA-256 of the town's files.

    Raises `InputError` where the files have changed.
    """
    if hash_town(fields["town"], Path(beside)) != version:
        raise InputError(f"{fields['town']}: the town was changed while the run was under way")
    poles = [pole for step in places for pole in Placed.load(work.inputs[step]).chosen]
    record_frames(fields, poles, Path(beside), work.folder, work.report).save(work.folder)


def deal_step(work: Work, path: str, split: SplitName, role: Role, seed: int, whole: bool, version: str) -> None:
    """Take one split from the dataset at `path`; `version`: SHA-256 of its manifest.

    Raises `InputError` where the manifest has changed.
    """
    if hash_manifest(Path(path)) != version:
        raise InputError(f"{path}: the dataset was changed while the run was under way")
    deal_frames(Path(path), split, role, seed, whole).save(work.folder)
