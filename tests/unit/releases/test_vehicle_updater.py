"""The updater of a fleet's vehicle: whom it trusts, what it runs in the shadow, and what ends its processes."""

from dataclasses import replace
from pathlib import Path

import pytest
from release_drives import Drives
from release_parties import Parties

from flcav.config import InputError, read_json
from flcav.dataset.recording.recorder import record
from flcav.fleet.vehicle import VehicleSettings
from flcav.releases.candidate import read_candidate
from flcav.releases.checking import FIRST_ROOT, trusts_roots
from flcav.releases.installation import fetch_release
from flcav.releases.repositories.metadata import read_released, read_root
from flcav.releases.rollout.updater import (
    DRIVE,
    FOLDER,
    TASK,
    RecordedDrive,
    _run_apart,
    _run_shadow,
    equip_vehicle,
)
from flcav.sensors.frame import Frame
from flcav.storage.files import write_json


def test_a_vehicle_is_equipped_with_both_roots_and_a_drive(parties: Parties, tmp_path: Path):
    own, drive = tmp_path / "cav0", RecordedDrive("data", "s0", "cav0")
    roots = read_root(parties.image), read_root(parties.director)
    with pytest.raises(InputError, match="is no vehicle's folder"):
        equip_vehicle(own, roots, drive)
    VehicleSettings("127.0.0.1:3", 1, 2).save(own)
    equip_vehicle(own, None, drive)
    assert RecordedDrive.from_json(read_json(own / FOLDER / DRIVE), "drive") == drive
    assert not trusts_roots(own / FOLDER)
    equip_vehicle(own, roots, None)
    assert trusts_roots(own / FOLDER)
    (own / FOLDER / "metadata" / "director" / FIRST_ROOT).unlink()
    assert not trusts_roots(own / FOLDER)


def test_a_new_network_runs_in_the_shadow_and_a_roll_back_does_not(
    parties: Parties, recorded_frame: Frame, tmp_path: Path
):
    for party in ("image", "director"):
        parties.release(party, 2)
    found = fetch_release(parties.vehicle, "cav0", parties.sources(), TASK)
    assert found.driving is not None
    assert found.newer is not None
    assert _run_shadow(parties.vehicle, "cav0", found) is None  # nothing is met
    record(Drives(recorded_frame, 2), tmp_path / "drive")
    drive = RecordedDrive(str(tmp_path / "drive"), "s1", "cav0")
    write_json(parties.vehicle / DRIVE, drive.as_json())
    shadow = _run_shadow(parties.vehicle, "cav0", found)
    assert shadow is not None
    assert (shadow.vehicle, shadow.frames) == ("cav0", 1)
    assert (shadow.driving, shadow.candidate) == (found.driving.weights, found.newer.weights)
    back = replace(found.newer, candidate=found.newer.candidate.model_copy(update={"rolls_back": 1}))
    assert _run_shadow(parties.vehicle, "cav0", replace(found, newer=back)) is None


def test_an_update_that_ends_well_is_told_from_one_that_does_not(capfd: pytest.CaptureFixture[str]):
    def refuse() -> None:
        raise InputError("signed by others")

    assert _run_apart(lambda: None)
    assert not _run_apart(refuse)
    assert capfd.readouterr().out == "signed by others\n"


def test_a_release_is_read_from_the_repository_of_its_provider(parties: Parties):
    assert read_released(parties.image, TASK, 1) == read_candidate(parties.candidate(1))
    for folder, number in ((parties.image, 2), (parties.director, 1)):
        with pytest.raises(InputError, match=f"has no release {number} of objects, or is not the provider's"):
            read_released(folder, TASK, number)
