"""Fetching of metadata and targets from a repository's folder or web address, with bounds on size and time.

The size is bounded by The Update Framework's client, which stops at the length that it was told; here, the time is.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import url2pathname

from tuf.api.exceptions import DownloadError, DownloadHTTPError
from tuf.ngclient.fetcher import FetcherInterface

from flcav.config import InputError

if TYPE_CHECKING:
    import httpx

PIECE_BYTES = 1 << 16
LONGEST_S = 120.0  # of one file


class RepositoryFetcher(FetcherInterface):
    """A fetcher of files of a repository by `file://`, `http://` and `https://`; it gives up after `longest_s`."""

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
    """A fetcher of files by a client that has a vehicle's certificate."""

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


def locate(repository: str) -> str:
    """Return the address of a repository that is given as a folder or an address; raises `InputError` for neither."""
    try:
        scheme = urlsplit(repository).scheme
    except ValueError as error:
        raise InputError(f"{repository}: no address ({error})") from None
    if scheme in ("http", "https", "file"):
        return repository.rstrip("/")
    if not (Path(repository) / "metadata").is_dir():
        raise InputError(f"{repository}: neither a repository's folder, with metadata in it, nor an http(s) address")
    return Path(repository).resolve().as_uri()
