"""Disks that are full in mid-round: a vehicle's, then the server's. It is told, and goes on when there is room."""

import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from run_walkers import walk
from waiting import LONGEST_S

from flcav.federation.links.flower import Deployment, fleet_up
from flcav.fleet.authority import found_authority
from flcav.fleet.status import LEAST_ROOM, read_fleet_status
from flcav.fleet.supervisor import LOGS
from flcav.fleet.up import VEHICLES

COUNT, FULL_S = 2, 6.0
LATE = "vehicle-002"


def mount(folder: Path, megabytes: int) -> bool:
    folder.mkdir(parents=True, exist_ok=True)
    size = f"size={megabytes}m"
    try:
        return subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(folder)], check=False).returncode == 0
    except FileNotFoundError:
        return False


@pytest.fixture
def disks(tmp_path):
    """Yield the fleet's folder, which is a small file system, and that of a vehicle, another one."""
    fleet, vehicle = tmp_path / "fleet", tmp_path / "vehicle"
    mounted = [each for each in (fleet, vehicle) if mount(each, 48)]
    try:
        if len(mounted) < 2:
            pytest.skip("mounting is not permitted here")
        yield fleet, vehicle
    finally:
        for each in mounted:
            subprocess.run(["umount", "--lazy", str(each)], check=True)


def put_on(disk: Path, fleet: Path) -> None:
    """Have all that the vehicle writes on its own disk."""
    for kind in ("executor", "supernode", "forwarder"):
        (disk / "flower" / kind).mkdir(parents=True)
        for place, target in (
            (f"flower/{LATE}-{kind}", f"flower/{kind}"),
            (f"{LOGS}/{LATE}-{kind}.log", f"{kind}.log"),
        ):
            (fleet / place).parent.mkdir(exist_ok=True)
            (fleet / place).symlink_to(disk / target)
    (disk / "own").mkdir()
    (fleet / VEHICLES).mkdir()
    (fleet / VEHICLES / LATE).symlink_to(disk / "own")


class Filler(threading.Thread):
    """Fills a disk, and keeps it full until `told` says so for some seconds."""

    def __init__(self, disk: Path, told) -> None:
        super().__init__(daemon=True)
        self._path, self._told, self.ended = disk / "filler", told, False

    def run(self) -> None:
        begun, end = time.monotonic(), time.monotonic() + LONGEST_S
        while time.monotonic() < end and not (self._told() and time.monotonic() > begun + FULL_S):
            for size in (1 << 20, 1 << 10):
                try:
                    with self._path.open("ab", buffering=0) as file:
                        while file.write(bytes(size)) == size:
                            pass
                except OSError:
                    pass
            time.sleep(0.3)
        self.ended = self._told()
        self._path.unlink()


def tells_no_room(fleet: Path) -> bool:
    federation = read_fleet_status(fleet).federation
    return federation is not None and "no room on the vehicle's disk" in federation.describe()


def test_full_disks(disks):
    fleet, disk = disks
    found_authority(fleet)
    put_on(disk, fleet)
    expected = walk(None, COUNT, 4)
    fillers = {
        2: Filler(disk, lambda: tells_no_room(fleet)),
        4: Filler(fleet, lambda: read_fleet_status(fleet).free < LEAST_ROOM),
    }

    def begin(number, _):
        if number in fillers:
            fillers[number].start()

    with fleet_up(fleet, COUNT) as process:
        found = walk(Deployment(fleet), COUNT, 4, lasts_s=0.5, before_round=begin)
        assert process.poll() is None
    for filler in fillers.values():
        filler.join(LONGEST_S)
        assert filler.ended
    np.testing.assert_array_equal(expected["w"], found["w"])
    assert [*fleet.rglob("*.part"), *disk.rglob("*.part")] == []
