"""A node whose clock is a day off is refused by Flower, is named, and comes in once the clock is corrected."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import LONGEST_S, wait_for

from flcav.fleet.authority import open_authority
from flcav.fleet.keys import AUTHORITY, request_certificate
from flcav.fleet.status import read_fleet_status
from flcav.fleet.superlink import TRUSTED
from flcav.fleet.up import read_ready
from flcav.fleet.vehicle import install_vehicle

HERE = Path(__file__).parent
NAME = "without-clock"  # after all others: no federation of other tests has it


@pytest.mark.parametrize(("ahead_s", "told"), [(86400, "ahead"), (-86400, "behind")])
def test_clock_of_a_node_a_day_off(ahead_s, told, deployment, tmp_path):
    fleet, own, clock = deployment.folder, tmp_path / "vehicle", tmp_path / "clock"
    authority, name = open_authority(fleet), f"{NAME}-{told}"
    (tmp_path / "vehicle.crt").write_bytes(authority.register(request_certificate(own, name)))
    proxy = read_ready(fleet).proxy
    install_vehicle(own, tmp_path / "vehicle.crt", fleet / AUTHORITY, fleet / TRUSTED, proxy)
    clock.write_text(str(ahead_s))

    def is_named():
        of_clock = [
            each for each in read_fleet_status(fleet).refused if each.startswith(f"{name}: ") and "clock" in each
        ]
        return any(each.endswith(f"s {told}") for each in of_clock)

    def is_online():
        return next(each for each in read_fleet_status(fleet).vehicles if each.name == name).online

    process = subprocess.Popen(
        [sys.executable, str(HERE / "run_late_vehicle.py"), str(own), str(clock)], start_new_session=True
    )
    try:
        wait_for(is_named)
        assert not is_online()
        clock.write_text("0")
        wait_for(is_online)
    finally:
        authority.registry.revoke(name)
        os.kill(process.pid, signal.SIGTERM)
        process.wait(LONGEST_S)
