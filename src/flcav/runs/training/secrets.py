"""The file of the secrets that noise is drawn by, in the folder of a federation while it is under way.

Before the first message its SHA-256 is written beside it, by which a file that was lost or changed is distinguished
from one that has not been written yet. A hash of random bytes does not reveal them.
"""

import contextlib
import os
import re
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from flcav.config import InputError
from flcav.federation.noise import Secret
from flcav.storage.files import flush_all, sha256, write_bytes, write_in_pieces

SECRETS, SECRETS_HASH, PART = "secrets.safetensors", "secrets.sha256", ".secrets."
HASH = re.compile(rb"[0-9a-f]{64}")


def read_secrets(folder: Path, names: Collection[str], begun: bool) -> dict[str, Secret]:
    """Return the secrets of a federation, by name: none before they are drawn.

    `names` are those that it needs; `begun` says that it has sent messages, which the hash says, too. Raises
    `InputError` where the file or its hash is not what was written, or lacks secrets although they were drawn.
    """
    path, known = folder / SECRETS, folder / SECRETS_HASH
    written = known.read_bytes() if known.exists() else None
    if written is not None and not HASH.fullmatch(written):
        raise _lost(known, "is damaged")
    if written is not None and path.exists() and written != sha256(path).encode():
        raise _lost(path, f"is damaged, or {SECRETS_HASH} beside it")
    try:
        kept = load_file(path) if path.exists() else {}
    except SafetensorError:
        raise _lost(path, "is damaged") from None
    if (begun or written is not None) and not kept.keys() >= {*names}:
        raise _lost(path, "is missing or not complete")
    return {name: np.asarray(array, np.uint8) for name, array in kept.items()}


def _lost(path: Path, why: str) -> InputError:
    return InputError(f"{path} {why}: a round that is repeated would have other noise; remove the folder to begin anew")


def write_secrets(folder: Path, secrets: Mapping[str, Secret]) -> None:
    """Write the secrets of a federation, by name, to a file that only its owner may read; then the file's hash.

    Where there is a hash, both were written before, and stay as they are: `read_secrets` has compared them. Raises
    `InputError` where somebody else has written others since.
    """
    if (folder / SECRETS_HASH).exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    file, name = tempfile.mkstemp(prefix=PART, dir=folder)  # that nobody else may read
    os.close(file)
    try:
        write_in_pieces(Path(name), save(dict(secrets)))
        flush_all([Path(name)])
        with contextlib.suppress(FileExistsError):
            os.link(name, folder / SECRETS)  # where a rename would replace the file of another process
    finally:
        Path(name).unlink()
    flush_all([folder])
    kept = load_file(folder / SECRETS)
    if kept.keys() != secrets.keys() or not all(np.array_equal(kept[each], secrets[each]) for each in kept):
        raise InputError(f"{folder / SECRETS}: of another process, which federates here at the same time")
    write_bytes(folder / SECRETS_HASH, sha256(folder / SECRETS).encode())


def remove_secrets(folder: Path, *, used: bool = False) -> None:
    """Remove the secrets of a federation that has ended, or was refused.

    Where they are `used`, and the federation is not at its end, their hash stays: alone it means that they are gone, so
    that no round is repeated with others.
    """
    if not used:
        (folder / SECRETS_HASH).unlink(missing_ok=True)
    for path in (folder / SECRETS, *folder.glob(f"{PART}*")):  # the latter of processes that were killed
        path.unlink(missing_ok=True)
