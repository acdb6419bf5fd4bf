"""A vehicle's verification of a release, which both repositories must name with the same hash (Uptane).

Full verification by the Uptane Standard for Design and Implementation 2.1.0, section 5.4.4.2: root, timestamp, snapshot
and targets of the director, then of the image repository, by The Update Framework's client workflow; then both are
compared. Files are read from a repository's folder or fetched from its web address. Sizes are limited by The Update
Framework's client, which stops at the expected length, and times by the fetchers of this module.
"""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import url2pathname

from tuf.api.exceptions import DownloadError, DownloadHTTPError
from tuf.ngclient.fetcher import FetcherInterface

from flcav.config import InputError
from flcav.releases.candidate import Candidate, parse_candidate
from flcav.releases.keys import check_distinct
from flcav.releases.repositories.metadata import (
    LIFETIME,
    PARTY,
    Directive,
    is_assigned,
    read_directives,
    root_keys,
    target_names,
)

if TYPE_CHECKING:
    import httpx
    from tuf.api.metadata import Root, TargetFile
    from tuf.ngclient import Updater

PIECE_BYTES = 1 << 16
LONGEST_S = 120.0  # timeout of one file [s]


class RepositoryFetcher(FetcherInterface):
    """A fetcher of a repository's files by `file://`, `http://` and `https://`, with a timeout `longest_s` [s]."""

    def __init__(self, longest_s: float = LONGEST_S) -> None:
        self.longest_s = longest_s
        self.received_bytes = 0  # of all files so far

    def _fetch(self, url: str) -> Iterator[bytes]:
        until = time.monotonic() + self.longest_s
        for piece in self._open(url):
            if time.monotonic() > until:
                raise DownloadError(f"{url}: slow retrieval, not complete after {self.longest_s:g} s")
            self.received_bytes += len(piece)
            yield piece

    def _open(self, url: str) -> Iterator[bytes]:
        """Return the pieces of the file at `url`."""
        parts = urlsplit(url)
        if parts.scheme == "file":
            return _read(Path(url2pathname(parts.path)))
        from tuf.ngclient.urllib3_fetcher import Urllib3Fetcher

        return Urllib3Fetcher(socket_timeout=10).fetch(url)


class CertifiedFetcher(RepositoryFetcher):
    """A fetcher of files with an HTTP client that has a vehicle's certificate."""

    def __init__(self, client: "httpx.Client", longest_s: float = LONGEST_S) -> None:
        super().__init__(longest_s)
        self._client = client

    def _open(self, url: str) -> Iterator[bytes]:
        import httpx

        try:
            with self._client.stream("GET", url) as answer:
                if answer.status_code != httpx.codes.OK:
                    why = next(answer.iter_raw(200), b"").decode(errors="replace")
                    raise DownloadHTTPError(f"{answer.status_code}: {why}", answer.status_code)
                yield from answer.iter_raw(PIECE_BYTES)
        except httpx.HTTPError as error:
            raise DownloadError(f"{url}: {error}") from None


def _read(path: Path) -> Iterator[bytes]:
    if not path.is_file():
        raise DownloadHTTPError(f"{path}: no such file", 404)
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            yield piece


def locate_repository(repository: str) -> str:
    """Return the URL of a repository given as a folder or a URL; raises `InputError` for anything else."""
    try:
        scheme = urlsplit(repository).scheme
    except ValueError as error:
        raise InputError(f"{repository}: no address ({error})") from None
    if scheme in ("http", "https", "file"):
        return repository.rstrip("/")
    if not (Path(repository) / "metadata").is_dir():
        raise InputError(f"{repository}: neither a repository's folder, with metadata in it, nor an http(s) address")
    return Path(repository).resolve().as_uri()


REPOSITORIES = {"director": "customer", "image": "provider"}
FIRST_ROOT = "first.root.json"  # root with which the vehicle was delivered
CLOCK_SLACK = timedelta(hours=1)  # tolerated error of the vehicle's clock
MOST_METADATA_BYTES = 5_000_000


class ReleaseRefused(InputError):
    """The refusal of a release by a vehicle, with the reason."""


@dataclass(frozen=True)
class RepositorySources:
    """The URLs of both repositories, and their fetcher."""

    image: str
    director: str
    fetcher: RepositoryFetcher


@dataclass(frozen=True)
class Approved:
    """A release that both parties sign with the same hashes."""

    task: str
    release: int
    weights: str  # SHA-256
    bytes: int  # of the weights
    candidate: Candidate


@dataclass(frozen=True)
class CheckedRelease:
    """The result of a vehicle's verification: its assigned release, if any, and the downloaded metadata."""

    approved: Approved | None
    directive: Directive | None
    metadata_bytes: int
    updater: "Updater"  # of the image repository, for downloading the weights
    target: "TargetFile | None"


def open_sources(image: str, director: str) -> RepositorySources:
    """Return both repositories, given as folders or URLs; raises `InputError` for anything else."""
    return RepositorySources(locate_repository(image), locate_repository(director), RepositoryFetcher())


def trust_roots(folder: Path, image_root: bytes, director_root: bytes) -> None:
    """Write the two roots that a vehicle is delivered with to its folder.

    Raises `InputError` for roots of the wrong party, and for a key that both parties have, or one has twice.
    """
    from tuf.api.exceptions import RepositoryError
    from tuf.api.metadata import Metadata, Root

    keys = []
    for name, data in (("image", image_root), ("director", director_root)):
        try:
            root = Metadata[Root].from_bytes(data).signed
        except RepositoryError as error:
            raise InputError(
                f"root of the {REPOSITORIES[name]}: no metadata of The Update Framework ({error})"
            ) from None
        if root.unrecognized_fields.get(PARTY) != REPOSITORIES[name]:
            raise InputError(f"root of the {name} repository: is not of the {REPOSITORIES[name]}")
        keys += root_keys(root)
    check_distinct(keys, "the keys of provider and customer together")
    for name, data in (("image", image_root), ("director", director_root)):
        (folder / "metadata" / name).mkdir(parents=True, exist_ok=True)
        (folder / "metadata" / name / FIRST_ROOT).write_bytes(data)


def trusts_roots(folder: Path) -> bool:
    """Return whether a vehicle's folder has the roots of both parties."""
    return all((folder / "metadata" / name / FIRST_ROOT).is_file() for name in REPOSITORIES)


def check_release(
    folder: Path, vehicle: str, sources: RepositorySources, task: str = "objects", now: datetime | None = None
) -> CheckedRelease:
    """Return the release of a task that both repositories assign to `vehicle`, without installing it.

    folder: of the vehicle, with its roots and trusted metadata, see `trust_roots`. now: the vehicle's clock. Raises
    `ReleaseRefused` for anything that both parties did not sign, and for a wrong clock.
    """
    at = now or datetime.now(UTC)
    before = sources.fetcher.received_bytes
    director = _refresh(folder, "director", sources, at)
    image = _refresh(folder, "image", sources, at)
    _check_parties(director, image)
    directive = read_directives(director._trusted_set.targets.targets).get(task)
    if directive is None or not is_assigned(vehicle, task, directive):
        return CheckedRelease(None, directive, sources.fetcher.received_bytes - before, image, None)
    names = target_names(task, directive.release)
    weights, description = (_same(director, image, name) for name in names)
    candidate = _read_description(image, description, names[1])
    if (candidate.task, candidate.release) != (task, directive.release):
        raise ReleaseRefused(f"{names[1]}: describes release {candidate.release} of {candidate.task}")
    if candidate.weights != weights.hashes["sha256"]:
        raise ReleaseRefused(f"{names[1]}: a card of other weights than {names[0]}")
    approved = Approved(task, directive.release, candidate.weights, weights.length, candidate)
    return CheckedRelease(approved, directive, sources.fetcher.received_bytes - before, image, weights)


def _refresh(folder: Path, name: str, sources: RepositorySources, at: datetime) -> "Updater":
    """Run The Update Framework's client workflow on a repository, and return its updater."""
    from tuf.ngclient import Updater, UpdaterConfig

    kept = folder / "metadata" / name
    root = kept / FIRST_ROOT
    if not root.is_file():
        raise InputError(f"{folder}: no vehicle's folder, since it has no root of the {REPOSITORIES[name]}")
    address = getattr(sources, name)
    config = UpdaterConfig(targets_max_length=MOST_METADATA_BYTES)
    with refuse_release(f"{name} repository"):
        updater = Updater(
            str(kept),
            f"{address}/metadata/",
            str(folder / "incoming"),
            f"{address}/targets/",
            fetcher=sources.fetcher,
            config=config,
            bootstrap=root.read_bytes(),
        )
        # the client checks expiry against the vehicle's clock rather than this machine's
        updater._trusted_set.reference_time = at
        updater.refresh()
    _check_clock(updater, name, at)
    return updater


def _check_clock(updater: "Updater", name: str, at: datetime) -> None:
    """Raise `ReleaseRefused` if the timestamp was signed in the future: the clock is behind, or was set back."""
    timestamp = updater._trusted_set.timestamp
    made = timestamp.expires - LIFETIME["timestamp"]
    if at + CLOCK_SLACK < made:
        raise ReleaseRefused(
            f"the clock is off: it says {at:%Y-%m-%d %H:%M} UTC, and the {name} repository was signed at "
            f"{made:%Y-%m-%d %H:%M}"
        )


def _check_parties(director: "Updater", image: "Updater") -> None:
    """Raise `ReleaseRefused` if the current roots share a key between both parties, or have one twice."""
    roots: list[Root] = [director._trusted_set.root, image._trusted_set.root]
    try:
        check_distinct([key for root in roots for key in root_keys(root)], "the keys of provider and customer together")
    except InputError as error:
        raise ReleaseRefused(str(error)) from None


def _same(director: "Updater", image: "Updater", name: str) -> "TargetFile":
    """Return the image repository's entry of a target; raises `ReleaseRefused` unless the director's is equal."""
    with refuse_release(name):
        wanted, known = director.get_targetinfo(name), image.get_targetinfo(name)
    if wanted is None:
        raise ReleaseRefused(f"{name}: the customer's repository does not name it: a partial bundle")
    if known is None:
        raise ReleaseRefused(f"{name}: the provider's repository does not name it")
    if (wanted.hashes, wanted.length) != (known.hashes, known.length) or "sha256" not in known.hashes:
        raise ReleaseRefused(f"{name}: provider and customer name it with different hashes")
    return known


def _read_description(image: "Updater", target: "TargetFile", name: str) -> Candidate:
    with refuse_release(name):
        path = Path(image.download_target(target))
    try:
        return parse_candidate(path.read_bytes(), name)
    except InputError as error:
        raise ReleaseRefused(str(error)) from None
    finally:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def refuse_release(what: str) -> Iterator[None]:
    """Turn the errors of The Update Framework's client into `ReleaseRefused`, whose message starts with `what`."""
    from tuf.api.exceptions import DownloadError, RepositoryError

    try:
        yield
    except (DownloadError, RepositoryError) as error:
        raise ReleaseRefused(f"{what}: {type(error).__name__}: {str(error) or 'no answer'}") from None
