"""Offer of releases: the two repositories that a fleet's vehicles may read, and the latest report of each vehicle.

FLEET/releases/offer.json            where the published repositories of provider and customer are
FLEET/releases/vehicles/NAME.json    the latest report of a vehicle
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

from flcav.config import read_json
from flcav.fleet.release_report import ReleaseReport
from flcav.interface.wording import make_printable
from flcav.storage.files import write_json
from flcav.storage.records import Record

OFFER, REPORTS = "releases/offer.json", "releases/vehicles"
FILE = re.compile(r"(image|director)/((?:metadata|targets)(?:/[a-z0-9_]+(?:\.[a-z0-9]+)*)+)")  # no name has two dots
LARGEST_FILE = 1_000_000_000  # bytes


@dataclass(frozen=True)
class Offer(Record):
    """Folders of the published repositories, each with metadata and targets in it."""

    image: str  # the provider's
    director: str  # the customer's

    def save(self, fleet: Path) -> None:
        """Write it to a fleet's folder: its vehicles find the repositories from now on."""
        write_json(fleet / OFFER, self.as_json())


@dataclass(frozen=True)
class KeptReport(Record):
    """The latest report of a vehicle, and the time of its arrival."""

    vehicle: str  # by its certificate
    time: float  # [s since 1970]
    down_bytes: int  # that crossed the vehicle's sockets for releases until then, TLS included
    report: ReleaseReport

    def save(self, fleet: Path) -> None:
        """Write it to a fleet's folder, in the place of the one before."""
        write_json(fleet / REPORTS / f"{self.vehicle}.json", self.as_json())


def read_reports(fleet: Path) -> dict[str, KeptReport]:
    """Return the latest report of each vehicle, by name; its words are fit for a terminal."""
    paths = sorted((fleet / REPORTS).glob("[!.]*.json"))
    found = [KeptReport.from_json(read_json(path), str(path)) for path in paths]
    plain = [replace(each.report, refused=make_printable(each.report.refused)) for each in found]
    return {each.vehicle: replace(each, report=report) for each, report in zip(found, plain, strict=True)}


def find_offered(fleet: Path, asked: str) -> Path | None:
    """Return the file of a repository on offer that is asked for as image/… or director/…; None: there is none.

    Raises ValueError, in words, for a path that is no repository's, leads out of it, or has a file that is too large.
    """
    found = FILE.fullmatch(asked)
    if found is None:
        raise ValueError("is no file of a repository")
    if not (fleet / OFFER).is_file():
        return None
    offer = Offer.from_json(read_json(fleet / OFFER), str(fleet / OFFER))
    root = Path(offer.image if found[1] == "image" else offer.director).resolve()
    path = (root / found[2]).resolve()
    if not path.is_relative_to(root):
        raise ValueError("leads out of the repository")
    if not path.is_file():
        return None
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"is larger than {LARGEST_FILE} bytes")
    return path
