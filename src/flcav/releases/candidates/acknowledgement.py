"""Acknowledgements of a candidate: signatures in OpenSSF's format, which `model_signing verify key` verifies.

A party's key signs the hashes of all files of the candidate's folder but the acknowledgements and the page (a Sigstore
bundle with an in-toto statement; OpenSSF Model Signing v1.0). Keys are elliptic, of NIST's curves, in PEM files.
"""

import contextlib
import io
import tempfile
from dataclasses import dataclass
from pathlib import Path

from flcav.config import InputError
from flcav.releases.candidates.candidate import ACKNOWLEDGEMENTS, REPORT
from flcav.releases.keys import PublicKey, read_private_key

UNSIGNED = (ACKNOWLEDGEMENTS, REPORT)  # the page is drawn anew with every acknowledgement, from what is signed
MOST_BYTES = 1_000_000  # of a signature


@dataclass(frozen=True)
class Acknowledgement:
    """Signatures of one party: the names of its keys that signed, and how many are wanted."""

    party: str
    keys: tuple[str, ...]
    threshold: int


def acknowledge(folder: Path, key: Path) -> Path:
    """Sign the candidate in `folder` with the private key in the PEM file `key`; return the signature's file."""
    from model_signing import hashing, signing

    path = signature_path(folder, read_private_key(key).public)
    path.parent.mkdir(exist_ok=True)
    hashed = hashing.Config().set_ignored_paths(paths=UNSIGNED, ignore_git_paths=False)
    signing.Config().set_hashing_config(hashed).use_elliptic_key_signer(private_key=key).sign(folder, path)
    return path


def check_acknowledgement(folder: Path, key: PublicKey) -> None:
    """Raise `InputError` where a key does not sign the candidate in `folder`.

    Its signature is missing, of another format, or of another content than the folder has now.
    """
    from model_signing import hashing, verifying

    path = signature_path(folder, key)
    if not path.is_file():
        raise InputError(f"{folder}: has no signature of the key {key.short}")
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: too large for a signature")
    hashed = hashing.Config().set_ignored_paths(paths=UNSIGNED, ignore_git_paths=False)
    try:
        with tempfile.NamedTemporaryFile("w", suffix=".pub") as pem, contextlib.redirect_stdout(io.StringIO()):
            pem.write(key.pem)
            pem.flush()
            verifier = (
                verifying.Config().set_hashing_config(hashed).use_elliptic_key_verifier(public_key=Path(pem.name))
            )
            verifier.verify(folder, path)
    except Exception as error:  # a damaged bundle raises what its parser raises
        raise InputError(f"{path}: does not sign this candidate ({str(error)[:200] or type(error).__name__})") from None


def find_acknowledgements(folder: Path, party: str, keys: list[PublicKey], threshold: int) -> Acknowledgement:
    """Return the signatures of a party's keys over the candidate as it is now."""
    found = []
    for key in keys:
        with contextlib.suppress(InputError):
            check_acknowledgement(folder, key)
            found.append(key.short)
    return Acknowledgement(party, tuple(found), threshold)


def signature_path(folder: Path, key: PublicKey) -> Path:
    """Return the file of a key's signature over a candidate."""
    return folder / ACKNOWLEDGEMENTS / f"{key.short}.sig"
