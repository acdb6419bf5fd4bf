"""A roll-out to a fleet that is up: canaries, a stop, a roll-back, kills in mid-update, and who gets nothing."""

import os
import signal
import ssl
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import httpx
import pytest
from release_drives import Drives, make_frame
from release_parties import write_noisy, write_weights
from waiting import LONGEST_S, read_all_traffic, wait_for

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.fleet.authority import open_authority
from flcav.fleet.keys import AUTHORITY, request_certificate, take_certificate
from flcav.fleet.releases import (
    LARGEST_FILE,
    LARGEST_REPORT,
    RELEASES,
    REPORT,
    ReleaseReport,
    ShadowReport,
    read_reports,
)
from flcav.fleet.status import read_fleet_status
from flcav.fleet.supervisor import read_processes
from flcav.fleet.up import VEHICLES, read_ready
from flcav.fleet.vehicle import VehicleSettings
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import load_network
from flcav.releases.candidate import WEIGHTS
from flcav.releases.installation import Installed, read_installed
from flcav.releases.proposal import propose
from flcav.releases.repositories.metadata import MILLION, Directive
from flcav.releases.repositories.repository import create_repository, publish, stage_release
from flcav.releases.rollout.deployed import roll_out
from flcav.releases.rollout.stages import read_directive, roll_back, run_shadow
from flcav.releases.rollout.updater import FOLDER, open_client
from flcav.storage.files import sha256

NAMES = [f"vehicle-{number:03d}" for number in (1, 2, 3)]


@dataclass
class Parties:
    """Both parties, what drives, and the fleet."""

    folder: Path
    fleet: Path
    number: int = 0
    weights: Path | None = None
    first: Ledger = field(default_factory=lambda: Ledger(LinkMegabytes(0, 0)))  # of the first release

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

    def next(self, weights: Path, share: float = 0.01) -> None:
        """Let both release weights after those that drive."""
        self.number += 1
        out = self.folder / f"candidate{self.number}"
        propose(out, weights, self.weights or weights, self.number, "better", "all vehicles")
        self.release(out, share)
        self.weights = weights

    def offered(self) -> Path:
        """Return the file of the latest weights on the server's disk."""
        (found,) = (self.folder / "provider/repository/targets/objects" / str(self.number)).glob(f"*.{WEIGHTS}")
        return found

    def roll_out(self, ledger: Ledger | None = None):
        return roll_out(
            self.fleet,
            self.folder / "provider",
            self.folder / "customer",
            self.keys,
            ledger,
            data=self.folder / "drive",
            patience_s=LONGEST_S,
        )

    def reports(self) -> dict[str, ReleaseReport]:
        return {name: kept.report for name, kept in read_reports(self.fleet).items()}

    def installed(self, name: str) -> Installed:
        found = read_installed(self.fleet / VEHICLES / name / FOLDER)
        assert found is not None
        return found


@pytest.fixture(scope="module")
def parties(deployment, tmp_path_factory):
    """The first release drives all vehicles."""
    own = Parties(tmp_path_factory.mktemp("parties"), deployment.folder)
    record(Drives(make_frame(), 3), own.folder / "drive")
    for number in (1, 2):
        write_weights(own.folder / f"{number}.safetensors", number)
    create_repository(own.folder / "provider", "provider")
    create_repository(own.folder / "customer", "customer")
    own.next(own.folder / "1.safetensors", 1.0)
    found = own.roll_out(own.first)
    assert (found.complete, found.drive) == (True, {1: 3})
    return own


@pytest.fixture
def client(parties):
    """A client with the first vehicle's certificate."""
    with open_client(parties.fleet / VEHICLES / NAMES[0]) as found:
        yield found


def test_every_byte_of_the_first_release_is_booked(parties):
    """What the ledger has is what the kernel counted: the weights, what else the vehicles fetched, and TLS."""
    size, entries = parties.weights.stat().st_size, parties.first.entries
    assert {(entry.client, entry.link, entry.direction) for entry in entries} == {
        (name, "wireless", "down") for name in NAMES
    }
    metadata = sum(path.stat().st_size for path in parties.folder.glob("*/repository/metadata/*.json"))
    for entry in entries:
        assert size < entry.bytes < size + metadata + 100_000  # looks at the timestamp, TLS
    crossed = read_all_traffic(parties.fleet).vehicles
    for entry in entries:
        own = crossed[entry.client]
        assert own.socket_down >= own.release_down >= entry.bytes


def test_canaries_first_and_killed_in_mid_update(parties):
    """A vehicle is killed when it has verified a release and does not drive it yet: old weights, and then new ones."""
    old = parties.weights
    parties.next(parties.folder / "2.safetensors")
    new = parties.weights

    def find_updating():
        return [name for name, kept in parties.reports().items() if kept.verified > kept.release]

    with ThreadPoolExecutor(1) as threads:
        ended = threads.submit(parties.roll_out)
        name = wait_for(find_updating)[0]
        killed = read_processes(parties.fleet)[f"{name}-updater"]
        os.kill(killed, signal.SIGKILL)
        assert parties.installed(name).weights == sha256(old)
        found = ended.result()
    assert read_processes(parties.fleet)[f"{name}-updater"] != killed
    assert found.complete
    first, last = found.turns
    assert (first.assigned, last.assigned) == (2, 3)
    assert name in {each.vehicle for each in first.arrivals}
    assert first.decision.judgement == "go on"
    assert [parties.installed(name).weights for name in NAMES] == [sha256(new)] * 3


def test_shadow_runs_stop_it_and_the_roll_back_has_a_higher_number(parties, capsys):
    """The candidate is bad, and at first its weights are tampered with on the server's disk."""
    first, old = parties.number, parties.weights
    write_noisy(old, parties.folder / "noisy.safetensors")
    parties.next(parties.folder / "noisy.safetensors")
    bad = parties.weights
    whole = parties.offered().read_bytes()
    parties.offered().write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    customer, ledger = parties.folder / "customer", parties.folder / "ledger.parquet"
    keys = [each for key in parties.keys for each in ("--key", key)]
    where = ("--fleet", parties.fleet, "--provider", parties.folder / "provider", "--out", ledger, "--wait", LONGEST_S)

    def roll_out_by_command():
        with pytest.raises(SystemExit) as ended:
            run([str(each) for each in ("release", "rollout", customer, *keys, *where)])
        return ended.value.code

    def find_refusals():
        found = [kept.refused for kept in parties.reports().values() if kept.refused]
        return found if len(found) == 2 else None

    with ThreadPoolExecutor(1) as threads:
        code = threads.submit(roll_out_by_command)
        assert all("LengthOrHashMismatchError" in why for why in wait_for(find_refusals))
        assert [parties.installed(name).weights for name in NAMES] == [sha256(old)] * 3
        parties.offered().write_bytes(whole)
        assert code.result() == 1
    said = capsys.readouterr().out
    assert "stop: disagreement 1.000 (1.000 to 1.000) over 2 vehicles, limit 0.4\n" in said
    assert read_directive(customer, "objects").share == 0
    with pytest.raises(InputError, match="was stopped"):
        parties.roll_out()
    canaries = {entry.client for entry in Ledger.load(ledger).entries if entry.bytes > bad.stat().st_size}
    assert len(canaries) == 2

    data = Dataset.open(parties.folder / "drive")
    networks = [(load_network(OBJECTS, path), sha256(path)) for path in (old, bad)]
    expected = run_shadow("", [data.frame(0)], *networks)
    for name in canaries:
        assert parties.reports()[name].shadow == replace(expected, vehicle=name)
    told = {
        own.name: own.release.describe() for own in read_fleet_status(parties.fleet).vehicles if own.release is not None
    }
    assert all(told[name].endswith("disagreement 1.000 over 1 frame") for name in canaries)

    wait_for(lambda: all(parties.installed(name).weights == sha256(bad) for name in canaries))
    parties.number += 1
    back = parties.folder / f"candidate{parties.number}"
    roll_back(parties.folder / f"candidate{first}", parties.number, "It sees ghosts.", back, sha256(bad))
    parties.weights = old
    parties.release(back, 1.0)
    found = parties.roll_out()
    assert (found.complete, found.drive) == (True, {first + 2: 3})
    assert found.turns[0].wireless_mb < old.stat().st_size / 1e6  # vehicles keep the earlier weights
    assert [parties.installed(name).weights for name in NAMES] == [sha256(old)] * 3


def test_who_gets_nothing(parties, tmp_path):
    """A vehicle that is revoked, on the connection that is open, and one without a certificate."""
    authority = open_authority(parties.fleet)
    certificate = authority.register(request_certificate(tmp_path, "sold"), 1.0)
    take_certificate(tmp_path, certificate, (parties.fleet / AUTHORITY).read_bytes())
    VehicleSettings(read_ready(parties.fleet).proxy, 0, 0).save(tmp_path)
    path = "image/metadata/timestamp.json"
    with open_client(tmp_path) as client:
        assert client.get(path).content == (parties.folder / "provider/repository/metadata/timestamp.json").read_bytes()
        assert client.post(REPORT, content=ReleaseReport("objects", 0, 0).as_bytes()).status_code == 200
        authority.registry.revoke("sold")
        for answer in (client.get(path), client.post(REPORT, content=ReleaseReport("objects", 9, 9).as_bytes())):
            assert (answer.status_code, answer.text) == (401, "the certificate of sold is revoked")
        base = client.base_url
    assert parties.reports()["sold"].release == 0
    context = ssl.create_default_context(cafile=str(parties.fleet / AUTHORITY))
    with httpx.Client(base_url=base, verify=context, trust_env=False) as nobody, pytest.raises(httpx.TransportError):
        nobody.get(path)


@pytest.mark.parametrize(
    "path",
    [
        "../keys/1.pem",
        "image/../keys/1.pem",
        "image/metadata/../../keys/1.pem",
        "image/metadata/%2e%2e/%2e%2e/keys/1.pem",
        "image/metadata//etc/passwd",
        "image/keys/1.pem",
        "image/metadata/leaves.json",
        "image/metadata/large.json",
        "provider/metadata/timestamp.json",
        "image/metadata/",
        "report",
    ],
)
def test_paths_that_are_refused(path, parties, client):
    metadata = parties.folder / "provider" / "repository" / "metadata"
    (metadata / "leaves.json").unlink(missing_ok=True)
    (metadata / "leaves.json").symlink_to(parties.keys[0])
    with (metadata / "large.json").open("wb") as file:
        file.truncate(LARGEST_FILE + 1)
    url = client.base_url.copy_with(raw_path=f"{RELEASES}{path}".encode())
    assert client.get(url).status_code == 403
    assert client.put(url, content=b"x").status_code == 403


def test_messages_that_are_no_reports(parties, client):
    before = parties.reports()[NAMES[0]]
    shadow = ShadowReport("", "objects", "0" * 64, "1" * 64, frames=1, driving_found=5, candidate_found=6, agreed=5)
    for content in (
        b"",
        b"[]",
        b"{}",
        b"[" * 4000,
        replace(before, release=-1).as_bytes(),
        replace(before, task="../x").as_bytes(),
        replace(before, shadow=replace(shadow, agreed=6)).as_bytes(),  # would outweigh the disagreement of others
        replace(before, shadow=replace(shadow, candidate="1")).as_bytes(),
        replace(before, refused="x" * LARGEST_REPORT).as_bytes(),
        bytes(10**7),
    ):
        assert client.post(REPORT, content=content).status_code == 400
    assert parties.reports()[NAMES[0]] == before
    assert client.post(REPORT, content=replace(before, shadow=shadow).as_bytes()).status_code == 200
    assert parties.reports()[NAMES[0]].shadow == replace(shadow, vehicle=NAMES[0])  # by its certificate
