"""The file of the secrets that noise is drawn by, in the folder of a federation while it is under way.

Beside it lies its SHA-256, from before the first message on: by that a file that was lost or changed is told from one
that there has not been yet. Of random bytes a hash gives nothing away.
"""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from flcav.config import InputError
from flcav.federation.noise import Secret
from flcav.files import atomic_path, sha256, write_bytes, write_in_pieces

SECRETS, SECRETS_HASH = "secrets.safetensors", "secrets.sha256"


def read_secrets(folder: Path, names: Collection[str], begun: bool) -> dict[str, Secret]:
    """Return the secrets of a federation, by name: none before they are drawn.

    `names` are those that it needs; `begun` says that it has sent messages, which the hash says, too. Raises
    `InputError` where the file is not what was written, or lacks secrets although they were drawn.
    """
    path, known = folder / SECRETS, folder / SECRETS_HASH
    try:
        kept = load_file(path) if path.exists() else {}
    except SafetensorError:
        raise _lost(path, "is damaged") from None
    if path.exists() and known.exists() and known.read_text() != sha256(path):
        raise _lost(path, "is damaged")
    if (begun or known.exists()) and not kept.keys() >= {*names}:
        raise _lost(path, "is missing or not complete")
    return {name: np.asarray(array, np.uint8) for name, array in kept.items()}


def _lost(path: Path, why: str) -> InputError:
    return InputError(f"{path} {why}: a round that is repeated would have other noise; remove the folder to begin anew")


def write_secrets(folder: Path, secrets: Mapping[str, Secret]) -> None:
    """Write the secrets of a federation, by name, to a file that only its owner may read; then the file's hash."""
    with atomic_path(folder / SECRETS) as temporary:
        temporary.touch(mode=0o600)
        write_in_pieces(temporary, save(dict(secrets)))
    write_bytes(folder / SECRETS_HASH, sha256(folder / SECRETS).encode())


def remove_secrets(folder: Path) -> None:
    """Remove the secrets of a federation that has ended, the hash first: alone it would say that they were lost."""
    (folder / SECRETS_HASH).unlink(missing_ok=True)
    (folder / SECRETS).unlink(missing_ok=True)
