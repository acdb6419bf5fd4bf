"""A release candidate: weights with their card, hashes of data and recipe, the ledger, and acknowledgements.

A candidate is a folder. `candidate.json` has the SHA-256 of every other proposed file; `verification.json` and
`report.html` are added by the verification, `acknowledgements` by the signing parties, as signatures in OpenSSF's
format, which `model_signing verify key` verifies. A party's key signs the hashes of all files in the folder except the
acknowledgements and the page (a Sigstore bundle with an in-toto statement; OpenSSF Model Signing v1.0). Keys are
elliptic-curve keys on NIST's curves, in PEM files.
"""

import contextlib
import io
import json
import re
import tempfile
from dataclasses import dataclass
from hashlib import sha256 as sha256_of
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from flcav.config import Config, InputError, Json, check_is_file, parse_config
from flcav.network.ledger import Link
from flcav.releases.keys import PublicKey, read_private_key
from flcav.storage.files import sha256, write_bytes

CANDIDATE = "candidate.json"
WEIGHTS = "weights.safetensors"
CARD = "card.md"
RECIPE = "recipe.yaml"
LEDGER = "ledger.parquet"
VERIFICATION = "verification.json"
REPORT = "report.html"
ACKNOWLEDGEMENTS = "acknowledgements"
FILES = (CANDIDATE, WEIGHTS, CARD, RECIPE, LEDGER, VERIFICATION, REPORT)
SIGNATURE = re.compile(rf"{ACKNOWLEDGEMENTS}/[0-9a-f]+\.sig")
LARGEST = 1_000_000_000  # bytes of weights
FORMAT = "flcav-candidate-1"
CARD_KEY = "flcav.card"  # as in `flcav.perception.weights`, which needs torch
MOST_HEADER_BYTES = 10_000_000
MOST_TEXT_BYTES = 10_000_000  # of a description, a card or a verification

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class DataHash(Config):
    """The provenance of one training or validation dataset of a network."""

    name: str
    manifest: Sha256  # of its manifest, which lists the hashes of all its files
    town: str | None = None
    seed: int | None = None  # of its traffic; the same town and seed have the same scenes
    split: str | None = None
    use: Literal["training", "validation"] = "training"


class LedgerSum(Config):
    """The bytes of a candidate's training in one stage, on one link, in one direction."""

    stage: str
    link: Link
    direction: Literal["up", "down"]
    bytes: int = Field(ge=0)


class Candidate(Config):
    """A release candidate, the content of `candidate.json`."""

    document: ClassVar[str | None] = None

    format: Literal["flcav-candidate-1"] = FORMAT
    task: str = Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")
    release: int = Field(ge=1, le=10**9)  # rises with every release of a task, roll-backs included
    changes: str = Field(max_length=4000)  # what changed
    audience: str = Field(max_length=1000)  # for whom
    network: str  # name of the network's configuration
    weights: Sha256
    driving: Sha256  # weights of the network that drives
    card: Sha256  # of the model card in the weights' metadata, as it is written there
    data: tuple[DataHash, ...]
    recipe: Sha256 | None = None
    ledger: Sha256 | None = None
    spent: tuple[LedgerSum, ...] = ()  # sums of the ledger
    rolls_back: int | None = None  # release whose weights are to drive again


def read_candidate(folder: Path) -> Candidate:
    """Return the description of the candidate in `folder`.

    Raises `InputError` for a folder of another format, and one with links, special files or too large texts.
    """
    path = folder / CANDIDATE
    if not path.is_file():
        raise InputError(f"{folder}: no release candidate, since it has no {CANDIDATE}")
    if path.stat().st_size > MOST_TEXT_BYTES:
        raise InputError(f"{path}: too large for a candidate's file")
    found = parse_candidate(path.read_bytes(), str(path))
    _check_kinds(folder)
    return found


def parse_candidate(data: bytes, origin: str) -> Candidate:
    """Return the candidate in the bytes of a `candidate.json`; raises `InputError` for another format."""
    try:
        values = json.loads(data, object_pairs_hook=_unique)
    except (ValueError, RecursionError):
        raise InputError(f"{origin}: not JSON with every key once, so no release candidate") from None
    found = values.get("format") if isinstance(values, dict) else None
    if found != FORMAT:
        raise InputError(f"{origin}: a bundle of the format {str(found)[:40]!r}, and {FORMAT!r} is wanted")
    return parse_config(Candidate, values, origin)


def _unique(pairs: list[tuple[str, Json]]) -> dict[str, Json]:
    """Return a JSON object; raises ValueError for a repeated key, which JSON readers treat differently."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is given twice")
    return found


def _check_kinds(folder: Path) -> None:
    """Raise `InputError` where a candidate's folder has links, special files, or too large files."""
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        if path.is_symlink() or path.is_dir() != (name == ACKNOWLEDGEMENTS) or not (path.is_file() or path.is_dir()):
            raise InputError(f"{path}: a candidate has files and the folder {ACKNOWLEDGEMENTS}, no links and no others")
        if path.is_file() and path.stat().st_size > (LARGEST if name in (WEIGHTS, LEDGER) else MOST_TEXT_BYTES):
            raise InputError(f"{path}: too large for a candidate's file")


def check_files(folder: Path, candidate: Candidate) -> None:
    """Raise `InputError` where a file of the candidate is missing, or differs in hash from its description."""
    wanted = {WEIGHTS: candidate.weights, RECIPE: candidate.recipe, LEDGER: candidate.ledger}
    for name, digest in wanted.items():
        path = folder / name
        if digest is None:
            if path.exists():
                raise InputError(f"{path}: is not in the candidate's description")
            continue
        check_is_file(path)
        if sha256(path) != digest:
            raise InputError(f"{path}: has another SHA-256 than the candidate's description says")
    if hash_card(folder / WEIGHTS) != candidate.card:
        raise InputError(f"{folder}: a card of other weights: that in {WEIGHTS} is not the one described")


def check_bundle(folder: Path) -> None:
    """Raise `InputError` where a candidate's folder has unknown files, or a card that differs from its weights'."""
    from flcav.perception.weights import read_card

    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and not (name in FILES or SIGNATURE.fullmatch(name)):
            raise InputError(f"{path}: is no file of a candidate; what is signed has no others")
    card = folder / CARD
    if not card.is_file() or card.read_bytes() != read_card(folder / WEIGHTS).markdown().encode():
        raise InputError(f"{card}: is not the card in the weights: a card of other weights")


def hash_card(weights: Path) -> str:
    """Return the SHA-256 of the model card in a safetensors file's metadata; raises `InputError` if there is none."""
    try:
        check_is_file(weights, None)
        with weights.open("rb") as file:
            # safetensors: the length of the header, 8 bytes, then the header as JSON
            size = int.from_bytes(file.read(8), "little")
            if size > MOST_HEADER_BYTES:
                raise ValueError("its header is too long")
            card = json.loads(file.read(size))["__metadata__"][CARD_KEY]
            return sha256_of(card.encode()).hexdigest()
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{weights}: no safetensors file with a model card") from None


def write_candidate_page(folder: Path, page: str) -> None:
    """Write the candidate's page."""
    write_bytes(folder / REPORT, page.encode())


UNSIGNED = (ACKNOWLEDGEMENTS, REPORT)  # the page is rewritten with every acknowledgement, from the signed files
MOST_BYTES = 1_000_000  # of a signature


@dataclass(frozen=True)
class Acknowledgement:
    """The acknowledgement of one party: its keys with a valid signature, and their threshold."""

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
    """Raise `InputError` unless a key signs the candidate in `folder`.

    The signature may be missing, of another format, or of other content.
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
    except Exception as error:  # a damaged bundle raises the errors of its parser
        raise InputError(f"{path}: does not sign this candidate ({str(error)[:200] or type(error).__name__})") from None


def find_acknowledgements(folder: Path, party: str, keys: list[PublicKey], threshold: int) -> Acknowledgement:
    """Return the valid signatures of a party's keys over the present candidate."""
    found = []
    for key in keys:
        with contextlib.suppress(InputError):
            check_acknowledgement(folder, key)
            found.append(key.short)
    return Acknowledgement(party, tuple(found), threshold)


def signature_path(folder: Path, key: PublicKey) -> Path:
    """Return the file of a key's signature over a candidate."""
    return folder / ACKNOWLEDGEMENTS / f"{key.short}.sig"
