"""A rehearsal: canaries first, downloads by radio, a stop by shadow runs, a roll-back that every vehicle takes."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from release_drives import Drives
from release_parties import Parties, write_noisy

from flcav.cli.main import run
from flcav.config import InputError, read_json
from flcav.dataset.recording.recorder import record
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks
from flcav.releases.candidate import WEIGHTS, read_candidate
from flcav.releases.proposal import propose
from flcav.releases.rollout import simulated_fleet
from flcav.releases.rollout.rehearsal import rehearse
from flcav.releases.rollout.stages import Rollout
from flcav.sensors.frame import Frame

VEHICLES, SCENES = 20, 4


@pytest.fixture
def drive(recorded_frame: Frame, tmp_path: Path) -> Path:
    """A recording of several drives."""
    record(Drives(recorded_frame, SCENES), tmp_path / "drive")
    return tmp_path / "drive"


@pytest.fixture(autouse=True)
def radio(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every scene lasts 20 s near one unit, but the last one, which is beyond coverage."""
    time_s = np.arange(5, 25, 0.1)
    shape = (len(time_s), 1, 1)

    def link(_: object, radio: Radio, poles: object, scene: str, seed: int) -> SimpleNamespace:
        loss = np.full(shape, 300.0 if scene == f"s{SCENES - 1}" else 90.0)
        states = np.zeros(shape, np.int8)
        return SimpleNamespace(
            links=RadioLinks(radio, time_s, ("cav0",), ("pole0",), np.full(shape, 50.0), states, loss)
        )

    monkeypatch.setattr(simulated_fleet, "link_scene", link)


@pytest.fixture
def noisy(parties: Parties) -> Path:
    """A candidate after the first release that finds objects everywhere."""
    first = parties.candidate(1) / WEIGHTS
    write_noisy(first, parties.folder / "noisy.safetensors")
    out = parties.folder / "noisy"
    propose(out, parties.folder / "noisy.safetensors", first, 2, "finds more", "all vehicles")
    return out


def test_a_candidate_that_agrees_reaches_the_whole_fleet(parties: Parties, drive: Path, tmp_path: Path):
    ledger = Ledger(LinkMegabytes(0, 0))
    found = rehearse(parties.candidate(2), parties.candidate(1), drive, tmp_path / "out", ledger, vehicles=VEHICLES)
    assert found.complete
    assert not found.stopped
    assert found.drive == {2: VEHICLES}
    shares = [turn.share for turn in found.turns]
    assert shares == sorted(shares)
    assert shares[-1] == 1
    arrived = [each for turn in found.turns for each in turn.arrivals if each.at_s is not None]
    assert sorted(each.vehicle for each in arrived) == [f"car{number:04d}" for number in range(VEHICLES)]
    weights = (parties.candidate(2) / WEIGHTS).stat().st_size
    assert all(each.bytes > weights and 0 <= each.at_s < 20 for each in arrived if each.at_s is not None)
    late = [each for turn in found.turns for each in turn.arrivals if each.at_s is None]
    assert late  # drove beyond coverage, and has it from a later drive
    assert {each.vehicle for each in late} <= {each.vehicle for each in arrived}
    down = {link: ledger.used_bytes(link, direction="down") for link in ("wireless", "wireline")}
    assert down["wireless"] == sum(each.bytes for turn in found.turns for each in turn.arrivals)
    assert weights < down["wireline"] < 2 * weights  # one unit fetches the files once, for the whole roll-out
    assert not (tmp_path / "out" / "fleet").exists()
    assert Rollout.from_json(found.as_json(), "test") == found


def test_shadow_runs_stop_a_candidate_and_every_vehicle_takes_the_roll_back(
    parties: Parties, noisy: Path, drive: Path, tmp_path: Path
):
    found = rehearse(noisy, parties.candidate(1), drive, tmp_path / "out", vehicles=VEHICLES)
    assert found.stopped
    assert found.complete
    assert found.drive == {3: VEHICLES}
    stop = next(turn for turn in found.turns if turn.decision is not None and turn.decision.judgement == "stop")
    assert stop.share < 1
    assert stop.reached < VEHICLES
    back = read_candidate(tmp_path / "out" / "rollback")
    assert (back.release, back.weights) == (3, read_candidate(parties.candidate(1)).weights)
    weights = (noisy / WEIGHTS).stat().st_size
    last = found.turns[found.turns.index(stop) + 1 :]
    assert all(each.bytes < weights / 10 for turn in last for each in turn.arrivals)  # vehicles keep earlier weights


def test_wrong_rehearsals_leave_nothing(parties: Parties, drive: Path, tmp_path: Path):
    first, second, out = parties.candidate(1), parties.candidate(2), tmp_path / "out"
    again = parties.candidate(3)
    propose(again, second / WEIGHTS, second / WEIGHTS, 2, "the same number", "all vehicles")
    for candidate, earlier, reason in (
        (first, second, "is proposed to replace another network"),
        (again, second, "release 2 does not rise above 2"),
    ):
        with pytest.raises(InputError, match=reason):
            rehearse(candidate, earlier, drive, out)
        assert not out.exists()


def test_the_command_writes_ledger_and_rehearsal(
    parties: Parties, noisy: Path, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    arguments = (
        noisy,
        "--earlier",
        parties.candidate(1),
        "--data",
        drive,
        "--out",
        out,
        "--vehicles",
        3,
    )
    with pytest.raises(SystemExit) as ended:
        run(["release", "rehearse", *map(str, arguments)])
    assert ended.value.code == 1
    said = capsys.readouterr().out
    assert "stopped and rolled back; in the end release 3: 3 vehicles" in said
    assert Rollout.from_json(read_json(out / "rehearsal.json"), "test").stopped
    assert Ledger.load(out / "ledger.parquet").used_bytes("wireless", direction="down") > 0
