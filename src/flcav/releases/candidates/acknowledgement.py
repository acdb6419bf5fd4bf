"""Acknowledgements of a candidate: signatures in OpenSSF's format, which `model_signing verify key` verifies.

A party's key signs the hashes of all files of the candidate's folder but the acknowledgements themselves (a Sigstore
bundle with an in-toto statement; OpenSSF Model Signing v1.0). Keys are elliptic, of NIST's curves, in PEM files.
"""

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path

from flcav.config import InputError, check_is_file
from flcav.releases.candidates.candidate import ACKNOWLEDGEMENTS
from flcav.releases.keys import PublicKey, read_private_key, read_public_key


def acknowledge(folder: Path, key: Path) -> Path:
    """Sign the candidate in `folder` with the private key in the PEM file `key`; return the signature's file."""
    from model_signing import hashing, signing

    owner = read_private_key(key).public
    path = folder / ACKNOWLEDGEMENTS / f"{owner.short}.sig"
    path.parent.mkdir(exist_ok=True)
    hashed = hashing.Config().set_ignored_paths(paths=[ACKNOWLEDGEMENTS], ignore_git_paths=False)
    signing.Config().set_hashing_config(hashed).use_elliptic_key_signer(private_key=key).sign(folder, path)
    return path


def check_acknowledgement(folder: Path, key: Path) -> Path:
    """Return the file of the signature of a public key (PEM file) over the candidate in `folder`.

    Raises `InputError` where it is missing, of another format, or of another content than the folder has now.
    """
    from model_signing import hashing, verifying

    owner = read_public_key(key)
    path = folder / ACKNOWLEDGEMENTS / f"{owner.short}.sig"
    if not path.is_file():
        raise InputError(f"{folder}: has no signature of the key {owner.short} ({key})")
    hashed = hashing.Config().set_ignored_paths(paths=[ACKNOWLEDGEMENTS], ignore_git_paths=False)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            verifier = verifying.Config().set_hashing_config(hashed).use_elliptic_key_verifier(public_key=key)
            verifier.verify(folder, path)
    except Exception as error:  # a damaged bundle raises what its parser raises
        raise InputError(f"{path}: does not sign this candidate ({str(error)[:200] or type(error).__name__})") from None
    return path


def find_acknowledgements(folder: Path, keys: Sequence[Path]) -> list[PublicKey]:
    """Return those of the public keys (PEM files) that sign the candidate as it is now."""
    found = []
    for key in keys:
        check_is_file(key)
        with contextlib.suppress(InputError):
            check_acknowledgement(folder, key)
            found.append(read_public_key(key))
    return found
