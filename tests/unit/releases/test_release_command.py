"""The commands of `flcav release`, from a proposal to a vehicle; wrong inputs get one sentence and exit code 2."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from release_parties import Parties

from flcav.cli.main import run
from flcav.releases.candidate import (
    ACKNOWLEDGEMENTS,
    CANDIDATE,
    REPORT,
    VERIFICATION,
    WEIGHTS,
    read_candidate,
)
from flcav.releases.verification.records import CandidateVerification, Comparison
from flcav.releases.verification.verify import write_verification

Call = Callable[..., tuple[int, str]]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    """Run `flcav release` with arguments; return its exit code and what it said."""

    def called(*arguments: object) -> tuple[int, str]:
        with pytest.raises(SystemExit) as ended:
            run(["release", *map(str, arguments)])
        out, err = capsys.readouterr()
        return int(ended.value.code or 0), out + err

    return called


def accept(folder: Path, accepted: bool = True) -> None:
    candidate = read_candidate(folder)
    found = CandidateVerification(
        candidate=candidate.weights,
        driving=candidate.driving,
        accepted=accepted,
        reasons=() if accepted else ("class Car lost",),
        undecided=False,
        margin=0.03,
        kept_share=0.8,
        frames=0,
        scenes=20,
        frames_to_decide=None,
        whole=Comparison("whole", "AP50", 50, 20, 0.5, 0.51, 0.4, 0.6, -0.01 if accepted else -0.2, 0.03, None, "kept"),
        guards=(),
        data=(),
        domain=None,
    )
    write_verification(folder, found)


def test_from_a_proposal_to_a_vehicle(parties: Parties, call: Call):
    candidate, image, director = parties.candidate(2), parties.image, parties.director
    accept(candidate)
    assert call("sign", candidate, "--repository", image, "--key", image / "keys" / "1.pem")[1].startswith(
        f"{image}: 1 of 2 signatures"
    )
    assert call("publish", image) == (2, f"flcav: {image}: 1 of 2 signatures of the provider\n")
    assert call("sign", candidate, "--repository", image, "--key", image / "keys" / "2.pem")[0] == 0
    keys = [each for number in (1, 2) for each in ("--key", director / "keys" / f"{number}.pem")]
    assert call("sign", candidate, "--repository", director, *keys, "--share", 0, "--vehicle", "cav0")[0] == 0
    for party in (image, director):
        assert call("publish", party)[0] == 0
    where = ("--image", image / "repository", "--director", director / "repository")
    assert call("install", parties.vehicle, "--name", "cav0", *where) == (0, "cav0: drives release 2 of objects\n")
    code, said = call("status", image, director, "--candidate", candidate)
    assert code == 0
    assert "releases 1, 2, version 3" in said
    assert "0% of the fleet" in said
    page = (candidate / REPORT).read_text()
    assert "acknowledged by both parties" in page
    assert read_candidate(candidate).weights in page


def test_an_acceptance_that_its_own_numbers_contradict_is_not_signed(parties: Parties, call: Call):
    candidate, key = parties.candidate(2), parties.image / "keys" / "1.pem"
    accept(candidate, accepted=False)
    path = candidate / VERIFICATION
    path.write_text(path.read_text().replace('"accepted": false', '"accepted": true'))
    code, said = call("sign", candidate, "--repository", parties.image, "--key", key)
    assert (code, "its own numbers say that it is not" in said) == (2, True)


def test_signatures_are_verified_by_the_signers_own_tool(parties: Parties, call: Call):
    candidate, key = parties.candidate(2), parties.image / "keys" / "1.pem"
    accept(candidate)
    assert call("sign", candidate, "--repository", parties.image, "--key", key)[0] == 0
    (signature,) = (candidate / ACKNOWLEDGEMENTS).glob("*.sig")

    def verify() -> int:
        command = ["-m", "model_signing", "verify", "key", candidate, "--signature", signature]
        asked = [sys.executable, *command, "--public_key", key.with_suffix(".pub")]
        return subprocess.run(asked, capture_output=True, check=False).returncode

    assert verify() == 0
    with (candidate / WEIGHTS).open("ab") as file:
        file.write(b"x")
    assert verify() != 0


def test_wrong_inputs_get_one_sentence(parties: Parties, call: Call, tmp_path: Path):
    candidate, image = parties.candidate(2), parties.image
    key = ("--key", image / "keys" / "1.pem")
    sign = ("sign", candidate, "--repository", image)
    assert call(*sign, *key) == (2, f"flcav: {candidate}: was not verified\n")
    accept(candidate, accepted=False)
    assert call(*sign, *key) == (2, f"flcav: {candidate}: was refused by its verification, so nobody signs it\n")
    accept(candidate)
    code, said = call(*sign, *key, *key)
    assert code == 2
    assert "is given twice among the keys of the provider" in said
    assert "--vehicle and --revoke are the customer's" in call(*sign, *key, "--vehicle", "cav0")[1]
    code, said = call(*sign, "--key", image / "keys" / "1.pub")
    assert (code, said) == (
        2,
        f"flcav: {image / 'keys' / '1.pub'}: holds no private key that can be read (PEM, without a password)\n",
    )
    (tmp_path / CANDIDATE).write_text('{"format": "other-1"}')
    code, said = call("sign", tmp_path, "--repository", image, *key)
    assert code == 2
    shutil.copyfile(candidate / "verification.json", tmp_path / "verification.json")
    code, said = call("sign", tmp_path, "--repository", image, *key)
    assert (code, "a bundle of the format 'other-1'" in said) == (2, True)
    where = ("--image", tmp_path / "nowhere", "--director", parties.director / "repository")
    code, said = call("install", parties.vehicle, "--name", "cav0", *where)
    assert (code, "neither a repository's folder" in said) == (2, True)
    code, said = call("install", tmp_path / "new", "--name", "cav0", "--image", "http://x", "--director", "http://y")
    assert (code, "no vehicle's folder" in said) == (2, True)
    code, said = call("rollout", parties.director, "--key", parties.director / "keys" / "1.pem")
    assert (code, "either --shadows or --share" in said) == (2, True)
    rollout = ("rollout", parties.director, "--key", parties.director / "keys" / "1.pem")
    code, said = call(*rollout, "--share", 1, "--wait", 9)
    assert (code, "--wait: is for a roll-out to a fleet" in said) == (2, True)
    code, said = call(*rollout, "--fleet", tmp_path)
    assert (code, "--fleet: takes --provider" in said) == (2, True)
    code, said = call(*rollout, "--fleet", tmp_path, "--provider", image)
    assert (code, "the fleet is not up" in said) == (2, True)
    code, said = call("equip", tmp_path, "--drive", "s/cav0")
    assert (code, "--data is missing" in said) == (2, True)
    code, said = call("equip", tmp_path)
    assert (code, "is no vehicle's folder" in said) == (2, True)
    assert call("status", tmp_path)[0] == 2
    assert call("init", "provider", "--out", tmp_path / "two", "--keys", 1)[0] == 2
    assert not (tmp_path / "two").exists()


def test_without_the_extra_the_command_to_install_it_is_named(call: Call, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("flcav.cli.releases.release.find_spec", lambda name: None)
    code, said = call("status", "nowhere")
    assert code == 2
    assert said.startswith("flcav: releases need tuf, which is in: ")
    assert "pip install" in said


def change_json(path: Path, **values: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"margin": 5.0}, "its own numbers say that it is not"),
        ({"scenes": 1}, "its own numbers say that it is not"),
        ({"reasons": ["class Car lost"]}, "its own numbers say that it is not"),
        ({"kept_share": 0.0}, "its own numbers say that it is not"),
        ({"driving": "0" * 64}, "beside another network than the candidate replaces"),
    ],
)
def test_a_verification_whose_figures_were_edited_is_not_signed(
    values: dict[str, object], said: str, parties: Parties, call: Call
):
    candidate = parties.candidate(2)
    accept(candidate)
    change_json(candidate / VERIFICATION, **values)
    code, told = call("sign", candidate, "--repository", parties.image, "--key", *parties.keys("image", 1))
    assert (code, said in told) == (2, True)


def add_link(folder: Path) -> None:
    (folder / "notes").symlink_to("/etc/hostname")


def link_acknowledgements(folder: Path) -> None:
    (folder / ACKNOWLEDGEMENTS).symlink_to(folder.parent)


def add_pipe(folder: Path) -> None:
    os.mkfifo(folder / "pipe")


def enlarge(folder: Path) -> None:
    os.truncate(folder / CANDIDATE, 10**10)  # sparse


def add_file(folder: Path) -> None:
    (folder / ".hidden.py").write_text("import this")


def replace_card(folder: Path) -> None:
    (folder / "card.md").write_text("# other")


def repeat_key(folder: Path) -> None:
    path = folder / CANDIDATE
    path.write_text(path.read_text().replace('"release": 2', '"release": 1, "release": 2'))


def roll_back_to_others(folder: Path) -> None:
    change_json(folder / CANDIDATE, rolls_back=1)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (add_link, "no links"),
        (link_acknowledgements, "no links"),
        (add_pipe, "no links and no others"),
        (enlarge, "too large"),
        (repeat_key, "every key once"),
        (add_file, "is no file of a candidate"),
        (replace_card, "a card of other weights"),
        (roll_back_to_others, "rolls back to 1, which has not its weights here"),
    ],
)
def test_a_spoilt_bundle_is_not_signed_and_nothing_is_written(
    spoil: Callable[[Path], None], said: str, parties: Parties, call: Call
):
    candidate = parties.candidate(2)
    accept(candidate)
    spoil(candidate)
    before = sorted(parties.folder.rglob("*"))
    code, told = call("sign", candidate, "--repository", parties.image, "--key", *parties.keys("image", 1))
    assert (code, said in told, told.count("\n")) == (2, True, 1)
    assert sorted(parties.folder.rglob("*")) == before


def test_wrong_words_and_names_leave_nothing(parties: Parties, call: Call):
    new, first = parties.folder / "new", parties.folder / "1.safetensors"
    made = ("--driving", first, "--release", 9, "--out", new)
    assert call("propose", first, *made, "--changes", "x" * 5000)[0] == 2
    assert call("rollback", parties.candidate(1), *made, "--reason", "x")[0] == 2  # was not verified
    accept(parties.candidate(1))
    assert call("rollback", parties.candidate(1), *made, "--reason", "x" * 5000)[0] == 2
    assert not new.exists()
    accept(parties.candidate(2))
    key = ("--key", *parties.keys("director", 1))
    assert call("sign", parties.candidate(2), "--repository", parties.director, *key, "--vehicle", "\udcff")[0] == 2
    where = ("--image", parties.image / "repository", "--director", parties.director / "repository")
    assert call("install", parties.vehicle, "--name", "\udcff", *where)[0] == 2
    assert call("install", parties.vehicle, "--name", "cav0", *where[:2], "--director", "http://[::1")[0] == 2


def test_shadow_runs_of_other_weights_or_impossible_ones_do_not_decide(parties: Parties, call: Call):
    rollout = ("rollout", parties.director, "--key", *parties.keys("director", 1), "--shadows", parties.folder / "s")
    (parties.folder / "s").mkdir()
    counts = {"frames": 9, "driving_found": 9, "candidate_found": 9, "agreed": 9}
    known = {"vehicle": "a", "task": "objects", "driving": "0" * 64, "candidate": "1" * 64, **counts}
    for values, said in (
        ({}, "of other weights than those of release 1"),
        ({"agreed": 99}, "more detections agree than there are"),
        ({"candidate": read_candidate(parties.candidate(1)).weights, "frames": 0}, "no shadow run of any frame"),
    ):
        (parties.folder / "s" / "a.json").write_text(json.dumps(known | values))
        code, told = call(*rollout)
        assert (code, said in told) == (2, True)


def test_metadata_of_another_role_and_another_online_key(parties: Parties, call: Call):
    shutil.copyfile(parties.image / "keys" / "1.pem", parties.image / "keys" / "online.pem")
    code, said = call("publish", parties.image)
    assert (code, "is not the online key" in said) == (2, True)
    metadata = parties.image / "repository" / "metadata"
    shutil.copyfile(metadata / "1.root.json", metadata / "timestamp.json")
    code, said = call("status", parties.image)
    assert (code, "metadata of the role root, and those of timestamp are wanted" in said) == (2, True)
