"""Releases on a fleet: the offered repositories, and the reports of vehicles on their driving networks.

FLEET/releases/offer.json            folders of the published repositories of provider and customer
FLEET/releases/vehicles/NAME.json    the latest report of a vehicle

A report is sent to the proxy, where the TLS certificate identifies the vehicle (a vehicle version manifest, Uptane
Standard for Design and Implementation 2.1.0, section 5.4.2.1.1, without separate ECUs).
"""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from flcav.config import InputError, read_json
from flcav.interface.wording import make_printable, plural
from flcav.storage.files import write_json
from flcav.storage.records import LEFT_OUT, Record

RELEASES = "/v1/flcav/release/"  # path at the proxy of the repositories' files, and of reports
REPORT = "report"
LARGEST_REPORT = 4096  # bytes of a report
MOST = 10**9  # bound of any number in a report
TASK, SHA256 = re.compile("[a-z][a-z0-9_]{0,31}"), re.compile("[0-9a-f]{64}")


@dataclass(frozen=True)
class ShadowReport(Record):
    """The result of a vehicle's shadow run: numbers of detections above the score threshold in use."""

    vehicle: str
    task: str
    driving: str  # SHA-256 of the weights
    candidate: str
    frames: int
    driving_found: int
    candidate_found: int
    agreed: int

    @property
    def disagreement(self) -> float:
        """Return 1 minus the Dice coefficient, in [0, 1]; 0 where neither found anything."""
        found = self.driving_found + self.candidate_found
        return 1 - 2 * self.agreed / found if found else 0.0

    def check(self) -> None:
        """Raise ValueError, with a sentence, for impossible numbers."""
        if not all(0 <= each < MOST for each in (self.frames, self.driving_found, self.candidate_found, self.agreed)):
            raise ValueError("a number below 0, or too large")
        if self.agreed > min(self.driving_found, self.candidate_found):
            raise ValueError("more detections agree than there are")
        if not all(SHA256.fullmatch(each) for each in (self.driving, self.candidate)):
            raise ValueError("SHA-256 of both networks is wanted")


@dataclass(frozen=True)
class ReleaseReport(Record):
    """A vehicle's report: its driving and its verified release, and their disagreement in the shadow run."""

    task: str
    release: int  # driving release; 0: none
    verified: int  # latest release with verified signatures and weights, driving or about to; 0: none
    refused: str = ""  # reason of refusing the offered release
    shadow: Annotated[ShadowReport | None, LEFT_OUT] = None  # of the verified release; None: no run

    def as_bytes(self) -> bytes:
        """Return the report as JSON, as it is sent."""
        return json.dumps(self.as_json()).encode()

    def describe(self) -> str:
        """Return the report in words."""
        text = f"drives release {self.release} of {self.task}" if self.release else f"drives no {self.task}"
        if self.verified > self.release:
            text += f", has verified release {self.verified}"
        if self.shadow is not None:
            text += f", disagreement {self.shadow.disagreement:.3f} over {plural(self.shadow.frames, 'frame')}"
        return f"{text}; refuses what is on offer: {self.refused}" if self.refused else text


def parse_report(data: bytes) -> ReleaseReport:
    """Return the report in a message; raises ValueError, with a sentence, for an invalid message."""
    try:
        found = ReleaseReport.from_json(json.loads(data), "report")
    except (InputError, ValueError, RecursionError):
        raise ValueError("the message is no release report") from None
    if found.shadow is not None:
        found.shadow.check()
    if not all(0 <= each < MOST for each in (found.release, found.verified)) or not TASK.fullmatch(found.task):
        raise ValueError("the message is no release report")
    return found


OFFER, REPORTS = "releases/offer.json", "releases/vehicles"
FILE = re.compile(r"(image|director)/((?:metadata|targets)(?:/[a-z0-9_]+(?:\.[a-z0-9]+)*)+)")  # no name has two dots
LARGEST_FILE = 1_000_000_000  # bytes


@dataclass(frozen=True)
class ReleaseOffer(Record):
    """The offer of a fleet: folders of the published repositories, which have metadata and targets."""

    image: str  # the provider's
    director: str  # the customer's

    def save(self, fleet: Path) -> None:
        """Write the offer to a fleet's folder, where its vehicles find it."""
        write_json(fleet / OFFER, self.as_json())


@dataclass(frozen=True)
class KeptReport(Record):
    """The latest report of a vehicle, with its time of arrival."""

    vehicle: str  # by its certificate
    time: float  # [s since 1970]
    down_bytes: int  # downloaded by the vehicle for releases so far, on its sockets, TLS included
    report: ReleaseReport

    def save(self, fleet: Path) -> None:
        """Write the report to a fleet's folder, over the previous one."""
        write_json(fleet / REPORTS / f"{self.vehicle}.json", self.as_json())


def read_reports(fleet: Path) -> dict[str, KeptReport]:
    """Return the latest reports by vehicle, with printable texts."""
    paths = sorted((fleet / REPORTS).glob("[!.]*.json"))
    found = [KeptReport.from_json(read_json(path), str(path)) for path in paths]
    plain = [replace(each.report, refused=make_printable(each.report.refused)) for each in found]
    return {each.vehicle: replace(each, report=report) for each, report in zip(found, plain, strict=True)}


def find_offered(fleet: Path, asked: str) -> Path | None:
    """Return the offered file with the path image/… or director/…; None if there is none.

    Raises ValueError, with a sentence, for a path of no repository, one that leads out of it, or too large a file.
    """
    found = FILE.fullmatch(asked)
    if found is None:
        raise ValueError("is no file of a repository")
    if not (fleet / OFFER).is_file():
        return None
    offer = ReleaseOffer.from_json(read_json(fleet / OFFER), str(fleet / OFFER))
    root = Path(offer.image if found[1] == "image" else offer.director).resolve()
    path = (root / found[2]).resolve()
    if not path.is_relative_to(root):
        raise ValueError("leads out of the repository")
    if not path.is_file():
        return None
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"is larger than {LARGEST_FILE} bytes")
    return path
