"""The updater of a fleet's vehicle, which follows the repositories offered by the fleet's proxy.

A release is fetched and verified, runs in the shadow of the driving network, and is then installed; every step is
reported to the fleet. Whenever the updater is killed, either the old or the new network drives.

VEHICLE/releases/                the folder of `vehicles.installation`
VEHICLE/releases/drive.json      the recorded drive in place of the vehicle's sensors
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
POLL_S, LONGEST_S = 2.0, 30.0  # interval of polling the customer's timestamp; longest after failures [s]
CHECK_S = 600.0  # interval of complete checks, even if the timestamp is unchanged [s]
LARGEST_ANSWER = 1 << 16  # bytes of a timestamp, or of a sentence
TIMEOUT = httpx.Timeout(30.0, connect=5.0)


@dataclass(frozen=True)
class RecordedDrive(Record):
    """A recorded drive, whose frames replace those of a vehicle's sensors."""

    data: str  # the dataset's folder
    scene: str
    agent: str


def equip_vehicle(folder: Path, roots: tuple[bytes, bytes] | None, drive: RecordedDrive | None) -> None:
    """Set up a fleet's vehicle for releases: install both roots, and the `drive` of its shadow runs.

    roots: those of the provider and of the customer; None: unchanged, as for `drive`. Raises `InputError` for roots of
    the wrong party, and where the folder is no vehicle's.
    """
    load_settings(folder)
    if roots is not None:
        trust_roots(folder / FOLDER, *roots)
    if drive is not None:
        write_json(folder / FOLDER / DRIVE, drive.as_json())


def run_updater(folder: Path) -> None:
    """Update the vehicle in `folder` whenever the customer's timestamp changes, until the parent process ends."""
    parent = os.getppid()
    pause = POLL_S
    seen = b""
    due = float("inf")
    client: httpx.Client | None = None
    while os.getppid() == parent:
        fine = True
        if trusts_roots(folder / FOLDER):
            client = client or open_client(folder)
            stamp = _ask(client)
            if stamp is None:  # reopened for the next request, as the certificate may have been replaced
                client.close()
                client = None
                fine = False
            elif stamp and (stamp != seen or time.monotonic() > due):
                fine = _run_apart(lambda: update_in_fleet(folder))
                if fine:
                    seen = stamp
                    due = time.monotonic() + CHECK_S
        pause = POLL_S if fine else min(2 * pause, LONGEST_S)
        time.sleep(pause)


def open_client(folder: Path) -> httpx.Client:
    """Return a client of the fleet's proxy with the certificate of the vehicle in `folder`."""
    base = f"https://{load_settings(folder).server}{RELEASES}"
    return httpx.Client(base_url=base, verify=vehicle_tls(folder), timeout=TIMEOUT, trust_env=False)


def update_in_fleet(folder: Path) -> None:
    """Fetch, verify, run in the shadow and install the release offered to the vehicle in `folder`, and report.

    Raises `InputError` if the vehicle refuses it, `httpx.HTTPError` if the proxy cannot be reached or refuses the
    vehicle.
    """
    home = folder / FOLDER
    vehicle = requested_name(read_request(folder / REQUEST))
    for left in (home / "networks").glob(".*.part"):  # left by an update that was killed
        left.unlink()
    # every stage is reported before the next, so that the fleet sees a vehicle that stops within one
    with open_client(folder) as client:
        base = str(client.base_url)
        sources = RepositorySources(f"{base}image", f"{base}director", CertifiedFetcher(client))
        report = ReleaseReport(TASK, 0, 0)
        try:
            driving = read_installed(home)
            report = _describe(home, driving)
            found = fetch_release(home, vehicle, sources, TASK)
            if found.newer is not None:
                report = replace(report, verified=found.newer.release, shadow=None)
                _report(client, report)
                if (shadow := _run_shadow(home, vehicle, found)) is not None:
                    write_json(home / SHADOW, shadow.as_json())
                    report = replace(report, shadow=shadow)
                    _report(client, report)
                report = _describe(home, install_release(home, found.newer))
        except InputError as error:
            _report(client, replace(report, refused=str(error)[:500]))
            raise
        _report(client, report)


def _describe(home: Path, driving: Installed | None) -> ReleaseReport:
    """Return the report of a vehicle without a pending release."""
    if driving is None:
        return ReleaseReport(TASK, 0, 0)
    shadow = None
    if (home / SHADOW).is_file():
        last = ShadowReport.from_json(read_json(home / SHADOW), str(home / SHADOW))
        shadow = last if last.candidate == driving.weights else None
    return ReleaseReport(driving.task, driving.release, driving.release, shadow=shadow)


def _run_shadow(home: Path, vehicle: str, found: Fetched) -> ShadowReport | None:
    """Return the shadow run of a fetched release; None for a roll-back, and without a driving network or a drive."""
    driving, newer = found.driving, found.newer
    if driving is None or newer is None or newer.candidate.rolls_back is not None or not (home / DRIVE).is_file():
        return None
    from flcav.dataset.store import Dataset
    from flcav.machine.threads import use_threads
    from flcav.perception.objects.task import OBJECTS
    from flcav.perception.weights import load_network
    from flcav.releases.rollout.stages import run_shadow

    use_threads(1)
    drive = RecordedDrive.from_json(read_json(home / DRIVE), str(home / DRIVE))
    data = Dataset.open(Path(drive.data))
    frames = map(data.frame, data.select(agents=[drive.agent], scenes=[drive.scene]))
    both = (driving, Installed(newer.task, newer.release, newer.weights))
    old, new = ((load_network(OBJECTS, weights_path(home, each)), each.weights) for each in both)
    return run_shadow(vehicle, frames, old, new)


def _ask(client: httpx.Client) -> bytes | None:
    """Return the customer's timestamp; empty if none is offered, None if the proxy does not answer."""
    try:
        status, content = _call(client, "GET", "director/metadata/timestamp.json")
    except httpx.HTTPError:
        return None
    return content if status == httpx.codes.OK else b"" if status == httpx.codes.NOT_FOUND else None


def _report(client: httpx.Client, report: ReleaseReport) -> None:
    """Send a report; raises `httpx.HTTPError` if it is refused."""
    status, why = _call(client, "POST", REPORT, report.as_bytes())
    if status != httpx.codes.OK:
        raise httpx.HTTPError(f"the report is refused: {status} {why.decode(errors='replace')[:200]}")


def _call(client: httpx.Client, method: str, path: str, content: bytes | None = None) -> tuple[int, bytes]:
    """Return status and body of the proxy's response; of a long body, the beginning."""
    with client.stream(method, path, content=content) as answer:
        return answer.status_code, next(answer.iter_raw(LARGEST_ANSWER), b"")


def _run_apart(do: Callable[[], None]) -> bool:
    """Return whether `do` succeeds in a forked process, whose memory is released afterwards."""
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
