"""The updater of a fleet's vehicle: it follows the repositories that the fleet's proxy offers.

A release is fetched and verified, runs beside the network that drives, and is then installed; the fleet is told of each
step. Wherever the updater is killed, the old network drives on, or the new one does.

VEHICLE/releases/                the folder of `vehicles.installation`
VEHICLE/releases/drive.json      what the vehicle meets
VEHICLE/releases/shadow.json     its last shadow run
"""

import os
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import httpx

from flcav.config import InputError, read_json
from flcav.fleet.forwarder import vehicle_tls
from flcav.fleet.keys import REQUEST, read_request, requested_name
from flcav.fleet.releases import RELEASES, REPORT, ReleaseReport, ShadowReport
from flcav.fleet.supervisor import end_with_parent
from flcav.fleet.vehicle import load_settings
from flcav.releases.checking import CertifiedFetcher, RepositorySources, trust_roots, trusts_roots
from flcav.releases.installation import (
    Fetched,
    Installed,
    fetch_release,
    install_release,
    read_installed,
    weights_path,
)
from flcav.storage.files import write_json
from flcav.storage.records import Record

FOLDER, DRIVE, SHADOW = "releases", "drive.json", "shadow.json"
TASK = "objects"
POLL_S, LONGEST_S = 2.0, 30.0  # between looks at the customer's timestamp; after one that failed, at most
CHECK_S = 600.0  # after which everything is checked, whether the timestamp is another one or not
LARGEST_ANSWER = 1 << 16  # bytes of a timestamp, or of a sentence
TIMEOUT = httpx.Timeout(30.0, connect=5.0)


@dataclass(frozen=True)
class RecordedDrive(Record):
    """The frames of a recording, in place of a vehicle's own sensors."""

    data: str  # the dataset's folder
    scene: str
    agent: str


def equip_vehicle(folder: Path, roots: tuple[bytes, bytes] | None, drive: RecordedDrive | None) -> None:
    """Let a fleet's vehicle follow releases: it trusts both roots, and its shadow runs are of `drive`.

    roots: those of the provider and of the customer; None, as for the drive: as it was. Raises `InputError` for roots
    of others, and where the folder is no vehicle's.
    """
    load_settings(folder)
    if roots is not None:
        trust_roots(folder / FOLDER, *roots)
    if drive is not None:
        write_json(folder / FOLDER / DRIVE, drive.as_json())


def run_updater(folder: Path) -> None:
    """Update the vehicle in `folder` whenever the customer signs anew, until the parent of this process ends."""
    parent, pause, seen, due = os.getppid(), POLL_S, b"", float("inf")
    client: httpx.Client | None = None
    while os.getppid() == parent:
        fine = True
        if trusts_roots(folder / FOLDER):
            client = client or open_client(folder)
            stamp = _ask(client)
            if stamp is None:  # the certificate may be another one when it asks again
                client.close()
                client, fine = None, False
            elif stamp and (stamp != seen or time.monotonic() > due):
                fine = _run_apart(lambda: update_in_fleet(folder))
                if fine:
                    seen, due = stamp, time.monotonic() + CHECK_S
        pause = POLL_S if fine else min(2 * pause, LONGEST_S)
        time.sleep(pause)


def open_client(folder: Path) -> httpx.Client:
    """Return a client of the fleet's proxy with the certificate of the vehicle in `folder`."""
    base = f"https://{load_settings(folder).server}{RELEASES}"
    return httpx.Client(base_url=base, verify=vehicle_tls(folder), timeout=TIMEOUT, trust_env=False)


def update_in_fleet(folder: Path) -> None:
    """Fetch, verify, run in the shadow and install what the fleet offers its vehicle in `folder`, and report.

    Raises `InputError` where the vehicle refuses it, `httpx.HTTPError` where the proxy is not there or refuses the
    vehicle.
    """
    own, vehicle = folder / FOLDER, requested_name(read_request(folder / REQUEST))
    for left in (own / "networks").glob(".*.part"):  # of an update that was killed
        left.unlink()
    with open_client(folder) as client:
        base = str(client.base_url)
        sources = RepositorySources(f"{base}image", f"{base}director", CertifiedFetcher(client))
        told = ReleaseReport(TASK, 0, 0)
        try:
            driving = read_installed(own)
            told = _describe(own, driving)
            found = fetch_release(own, vehicle, sources, TASK)
            if found.newer is not None:
                told = replace(told, verified=found.newer.release, shadow=None)
                _report(client, told)
                if (shadow := _run_shadow(own, vehicle, found)) is not None:
                    write_json(own / SHADOW, shadow.as_json())
                    told = replace(told, shadow=shadow)
                    _report(client, told)
                told = _describe(own, install_release(own, found.newer))
        except InputError as error:
            _report(client, replace(told, refused=str(error)[:500]))
            raise
        _report(client, told)


def _describe(own: Path, driving: Installed | None) -> ReleaseReport:
    """Return the report of a vehicle that waits for nothing."""
    if driving is None:
        return ReleaseReport(TASK, 0, 0)
    shadow = None
    if (own / SHADOW).is_file():
        last = ShadowReport.from_json(read_json(own / SHADOW), str(own / SHADOW))
        shadow = last if last.candidate == driving.weights else None
    return ReleaseReport(driving.task, driving.release, driving.release, shadow=shadow)


def _run_shadow(own: Path, vehicle: str, found: Fetched) -> ShadowReport | None:
    """Return the shadow run of what was fetched; None of a roll-back, and where nothing drives or nothing is met."""
    driving, newer = found.driving, found.newer
    if driving is None or newer is None or newer.candidate.rolls_back is not None or not (own / DRIVE).is_file():
        return None
    from flcav.dataset.store import Dataset
    from flcav.machine.threads import use_threads
    from flcav.perception.objects.task import OBJECTS
    from flcav.perception.weights import load_network
    from flcav.releases.rollout.stages import run_shadow

    use_threads(1)
    drive = RecordedDrive.from_json(read_json(own / DRIVE), str(own / DRIVE))
    data = Dataset.open(Path(drive.data))
    frames = map(data.frame, data.select(agents=[drive.agent], scenes=[drive.scene]))
    both = (driving, Installed(newer.task, newer.release, newer.weights))
    old, new = ((load_network(OBJECTS, weights_path(own, each)), each.weights) for each in both)
    return run_shadow(vehicle, frames, old, new)


def _ask(client: httpx.Client) -> bytes | None:
    """Return the customer's timestamp; nothing where none is on offer, None where the proxy does not answer."""
    try:
        status, content = _call(client, "GET", "director/metadata/timestamp.json")
    except httpx.HTTPError:
        return None
    return content if status == httpx.codes.OK else b"" if status == httpx.codes.NOT_FOUND else None


def _report(client: httpx.Client, report: ReleaseReport) -> None:
    """Send a report; raises `httpx.HTTPError` where it is not taken."""
    status, why = _call(client, "POST", REPORT, report.as_bytes())
    if status != httpx.codes.OK:
        raise httpx.HTTPError(f"the report is refused: {status} {why.decode(errors='replace')[:200]}")


def _call(client: httpx.Client, method: str, path: str, content: bytes | None = None) -> tuple[int, bytes]:
    """Return the status and the body of the proxy's answer; of a body that is too long, the beginning."""
    with client.stream(method, path, content=content) as answer:
        return answer.status_code, next(answer.iter_raw(LARGEST_ANSWER), b"")


def _run_apart(do: Callable[[], None]) -> bool:
    """Return whether `do` ended well in a process of its own, whose memory is free again afterwards."""
    parent, child = os.getpid(), os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    code = 1
    try:
        end_with_parent(parent, signal.SIGKILL)
        do()
        code = 0
    except (InputError, httpx.HTTPError) as error:
        print(error, flush=True)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)
