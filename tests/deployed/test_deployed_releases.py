"""A roll-out to a fleet that is up: canaries, a stop, a roll-back, kills in mid-update, and who gets nothing."""

import os
import signal
import ssl
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import httpx
import pytest
from release_drives import Drives, make_frame
from release_parties import write_noisy, write_weights

from flcav.cli.main import run
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.federation.fleet.authority import open_authority
from flcav.federation.fleet.keys import AUTHORITY, request_certificate, take_certificate
from flcav.federation.fleet.releases.offer import LARGEST_FILE, read_reports
from flcav.federation.fleet.status import read_status
from flcav.federation.fleet.supervisor import read_processes
from flcav.federation.fleet.traffic import read_traffic
from flcav.federation.fleet.up import VEHICLES, read_ready
from flcav.federation.messages.release_report import LARGEST, RELEASES, REPORT, ReleaseReport
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import load_network
from flcav.releases.candidates.candidate import WEIGHTS
from flcav.releases.candidates.proposal import propose
from flcav.releases.repositories.creation import create_repository
from flcav.releases.repositories.directive import MILLION, Directive
from flcav.releases.repositories.repository import publish, stage_release
from flcav.releases.rollout.deployed import roll_out
from flcav.releases.rollout.shadow import run_shadow
from flcav.releases.rollout.stages import read_directive, roll_back
from flcav.releases.rollout.updater import FOLDER, open_client
from flcav.releases.vehicles.installation import Installed, read_installed
from flcav.storage.files import sha256

NAMES = [f"vehicle-{number:03d}" for number in (1, 2, 3)]


@dataclass
class Parties:
    """Both parties, what drives, and the fleet."""

    folder: Path
    fleet: Path
    number: int = 0
    weights: Path = Path()

    @property
    def keys(self) -> list[Path]:
        return [self.folder / "customer" / "keys" / f"{number}.pem" for number in (1, 2)]

    def release(self, candidate: Path, share: float = 0.01) -> None:
        """Let both sign and publish a candidate."""
        for party in ("provider", "customer"):
            keys = [self.folder / party / "keys" / f"{number}.pem" for number in (1, 2)]
            own = Directive(release=self.number, share_ppm=round(share * MILLION)) if party == "customer" else None
            stage_release(self.folder / party, candidate, keys, own)
            publish(self.folder / party)

    def propose(self, weights: Path) -> Path:
        """Return the next candidate."""
        self.number += 1
        out = self.folder / f"candidate{self.number}"
        propose(out, weights, self.weights, self.number, "better", "all vehicles")
        return out

    def offered(self) -> Path:
        """Return the file of the latest weights on the server's disk."""
        (found,) = (self.folder / "provider/repository/targets/objects" / str(self.number)).glob(f"*.{WEIGHTS}")
        return found

    def roll_out(self, ledger: Ledger | None = None, patience_s: float = 60.0):
        return roll_out(
            self.fleet,
            self.folder / "provider",
            self.folder / "customer",
            self.keys,
            ledger,
            data=self.folder / "drive",
            patience_s=patience_s,
        )

    def installed(self, name: str) -> Installed:
        found = read_installed(self.fleet / VEHICLES / name / FOLDER)
        assert found is not None
        return found


@pytest.fixture(scope="module")
def parties(deployment, tmp_path_factory):
    """The first release drives all vehicles."""
    own = Parties(tmp_path_factory.mktemp("parties"), deployment.folder)
    record(Drives(make_frame(), 3), own.folder / "drive")
    for number in (1, 2, 3):
        write_weights(own.folder / f"{number}.safetensors", number)
    create_repository(own.folder / "provider", "provider")
    create_repository(own.folder / "customer", "customer")
    own.weights = own.folder / "1.safetensors"
    own.release(own.propose(own.weights), 1.0)
    ledger = Ledger(LinkMegabytes(0, 0))
    found = own.roll_out(ledger)
    assert (found.complete, found.drive) == (True, {1: 3})
    print("\n".join(found.lines()))
    return own


def test_all(parties):
    print(read_reports(parties.fleet))
