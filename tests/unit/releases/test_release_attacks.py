"""The attacks that The Update Framework (specification, 1.5.2) and Uptane (standard, 4.2) list, by their names."""

import contextlib
import json
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import repeat
from pathlib import Path

import pytest
from release_parties import ALL, Parties, write_weights
from securesystemslib.signer import SSlibKey
from tuf.api.metadata import Metadata, TargetFile

from flcav.config import InputError
from flcav.releases.candidate import CANDIDATE, WEIGHTS, Candidate, read_candidate
from flcav.releases.checking import ReleaseRefused, RepositoryFetcher, check_release, trust_roots
from flcav.releases.installation import read_installed, update_vehicle, weights_path
from flcav.releases.keys import generate_key, read_private_key
from flcav.releases.repositories import repository
from flcav.releases.repositories.metadata import (
    Directive,
    load_root,
    load_targets,
    read_root,
    sign_online,
    target_names,
)
from flcav.releases.repositories.repository import (
    create_repository,
    publish,
    replace_online_key,
    stage_directive,
    stage_release,
)

EVERYBODY = Directive(release=2, share_ppm=ALL)


def drives(parties: Parties) -> int:
    installed = read_installed(parties.vehicle)
    assert installed is not None
    return installed.release


def refuses(parties: Parties, reason: str, sources=None, **changes) -> None:
    with pytest.raises(ReleaseRefused, match=reason):
        update_vehicle(parties.vehicle, "cav0", sources or parties.sources(), **changes)
    assert drives(parties) == 1


def sign_targets(parties: Parties, party: str, names: dict[str, Path], directive: Directive | None) -> None:
    """Let two keys of a party sign targets that no honest command would."""
    files = {name: TargetFile.from_file(name, str(path), ["sha256"]) for name, path in names.items()}
    for name, path in names.items():
        kept = parties.folder / party / "repository" / "targets" / name
        kept.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, kept.with_name(f"{files[name].hashes['sha256']}.{kept.name}"))
        if directive and name.endswith(WEIGHTS):
            files[name].unrecognized_fields["custom"] = {"directive": directive.model_dump(mode="json")}
    alone = party == "director"
    keys = parties.keys(party, 1, 2)
    repository._stage(parties.folder / party, files, "objects", alone, keys, datetime.now(UTC))
    publish(parties.folder / party)


def test_what_both_name_is_installed(parties: Parties):
    parties.release("image", 2)
    parties.release("director", 2)
    parties.update()
    assert drives(parties) == 2


def test_two_signatures_of_the_provider_and_none_of_the_customer(parties: Parties):
    parties.release("image", 2)
    parties.update()
    assert drives(parties) == 1


def test_colluding_director_names_what_the_provider_never_did(parties: Parties):
    parties.release("director", 2)
    refuses(parties, "the provider's repository does not name it")


def test_colluding_director_names_other_weights_under_a_release_of_the_provider(parties: Parties, tmp_path: Path):
    parties.release("image", 2)
    write_weights(tmp_path / "other.safetensors", 3)
    names = target_names("objects", 2)
    files = {names[0]: tmp_path / "other.safetensors", names[1]: parties.candidate(2) / CANDIDATE}
    sign_targets(parties, "director", files, EVERYBODY)
    refuses(parties, "provider and customer name it with different hashes")


def test_arbitrary_software_by_a_wrong_key(parties: Parties, tmp_path: Path):
    generate_key(tmp_path / "thief.pem")
    with pytest.raises(InputError, match="is no key of the provider"):
        stage_release(parties.image, parties.candidate(2), [tmp_path / "thief.pem"])
    parties.release("image", 2)
    path = parties.image / "repository" / "metadata" / "3.targets.json"
    forged = Metadata.from_file(str(path))
    forged.sign(read_private_key(tmp_path / "thief.pem").signer())  # replaces the signatures
    path.write_bytes(forged.to_bytes())
    refuses(parties, "UnsignedMetadataError")


def test_one_signature_of_two_is_not_published(parties: Parties):
    first = parties.keys("image", 1)
    assert not stage_release(parties.image, parties.candidate(2), first).complete
    assert not stage_release(parties.image, parties.candidate(2), first).complete  # the same owner again
    with pytest.raises(InputError, match="1 of 2 signatures"):
        publish(parties.image)
    assert stage_release(parties.image, parties.candidate(2), parties.keys("image", 3)).complete
    assert publish(parties.image) == 3


def test_a_server_that_publishes_one_signature_of_two(parties: Parties):
    stage_release(parties.image, parties.candidate(2), parties.keys("image", 1))
    staged = parties.image / "staged" / "targets.json"
    shutil.copyfile(staged, parties.image / "repository" / "metadata" / "3.targets.json")
    staged.unlink()
    online = read_private_key(parties.image / "keys" / "online.pem")
    metadata = parties.image / "repository" / "metadata"
    snapshot, timestamp = (Metadata.from_file(str(metadata / name)) for name in ("2.snapshot.json", "timestamp.json"))
    sign_online(metadata, snapshot, timestamp, online, datetime.now(UTC), 3)
    refuses(parties, "1/2")


def test_tampered_weights(parties: Parties):
    parties.release("image", 2)
    parties.release("director", 2)
    (kept,) = (parties.image / "repository" / "targets" / "objects" / "2").glob(f"*.{WEIGHTS}")
    data = bytearray(kept.read_bytes())
    data[-1] ^= 1
    kept.write_bytes(data)
    refuses(parties, "LengthOrHashMismatchError")


def test_weights_that_were_changed_in_the_vehicle_are_not_loaded(parties: Parties):
    installed = read_installed(parties.vehicle)
    assert installed is not None
    with weights_path(parties.vehicle, installed).open("ab") as file:
        file.write(b"x")
    with pytest.raises(ReleaseRefused, match="is not the network that was installed"):
        read_installed(parties.vehicle)


def test_indefinite_freeze_ends_with_the_timestamp(parties: Parties):
    refuses(parties, "ExpiredMetadataError", now=datetime.now(UTC) + timedelta(days=2))


def test_freeze_by_a_clock_that_was_set_back(parties: Parties):
    refuses(parties, "the clock is off", now=datetime.now(UTC) - timedelta(days=2))


def test_rollback_of_the_repository(parties: Parties, tmp_path: Path):
    shutil.copytree(parties.director / "repository", tmp_path / "old")
    publish(parties.director)  # renews snapshot and timestamp
    parties.update()
    sources = replace(parties.sources(), director=(tmp_path / "old").as_uri())
    refuses(parties, "BadVersionNumberError", sources)


def test_rollback_to_an_older_release_by_both_parties(parties: Parties):
    parties.release("image", 2)
    parties.release("director", 2)
    parties.update()
    names = target_names("objects", 1)
    files = dict(zip(names, (parties.candidate(1) / WEIGHTS, parties.candidate(1) / CANDIDATE), strict=True))
    sign_targets(parties, "director", files, Directive(release=1, share_ppm=ALL))
    with pytest.raises(ReleaseRefused, match="does not rise above 2"):
        parties.update()
    assert drives(parties) == 2


def test_fast_forward_is_overcome_by_a_new_online_key(parties: Parties):
    metadata = parties.image / "repository" / "metadata"
    honest = (metadata / "timestamp.json").read_bytes()
    stolen = read_private_key(parties.image / "keys" / "online.pem")
    forged = Metadata.from_bytes(honest)
    forged.signed.version = 10**9
    forged.sign(stolen.signer())
    (metadata / "timestamp.json").write_bytes(forged.to_bytes())
    parties.update()  # the vehicle trusts the forged version
    (metadata / "timestamp.json").write_bytes(honest)
    refuses(parties, "BadVersionNumberError")
    replace_online_key(parties.image, parties.keys("image", 2, 3))
    parties.release("image", 2)
    parties.release("director", 2)
    parties.update()
    assert drives(parties) == 2


def test_mix_and_match_of_metadata_of_different_times(parties: Parties):
    metadata = parties.director / "repository" / "metadata"
    old = (metadata / "2.targets.json").read_bytes()
    parties.release("image", 2)
    parties.release("director", 2)
    (metadata / "3.targets.json").write_bytes(old)
    refuses(parties, "BadVersionNumberError")


class Flood(RepositoryFetcher):
    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name

    def _open(self, url: str) -> Iterator[bytes]:
        return repeat(bytes(1 << 16)) if self.name in url else super()._open(url)


@pytest.mark.parametrize("name", ["timestamp.json", "snapshot.json", "targets.json", CANDIDATE, WEIGHTS])
def test_endless_data(parties: Parties, name: str):
    parties.release("image", 2)
    parties.release("director", 2)
    refuses(parties, "DownloadLengthMismatchError", replace(parties.sources(), fetcher=Flood(name)))


class Trickle(RepositoryFetcher):
    def _open(self, url: str) -> Iterator[bytes]:
        for piece in super()._open(url):
            time.sleep(0.02)
            yield piece


def test_slow_retrieval(parties: Parties):
    refuses(parties, "slow retrieval", replace(parties.sources(), fetcher=Trickle(longest_s=0.01)))


def test_drop_request(parties: Parties, tmp_path: Path):
    (tmp_path / "metadata").mkdir()
    refuses(parties, "DownloadHTTPError", replace(parties.sources(), image=tmp_path.as_uri()))


def test_partial_bundle(parties: Parties):
    parties.release("image", 2)
    sign_targets(parties, "director", {target_names("objects", 2)[0]: parties.candidate(2) / WEIGHTS}, EVERYBODY)
    refuses(parties, "a partial bundle")


def test_mixed_bundles(parties: Parties):
    names = target_names("objects", 2)
    files = dict(zip(names, (parties.candidate(2) / WEIGHTS, parties.candidate(1) / CANDIDATE), strict=True))
    sign_targets(parties, "image", files, None)
    sign_targets(parties, "director", files, EVERYBODY)
    refuses(parties, "describes release 1")


def test_a_card_of_other_weights(parties: Parties, tmp_path: Path):
    described = read_candidate(parties.candidate(1)).model_copy(update={"release": 2})
    (tmp_path / CANDIDATE).write_text(described.model_dump_json())
    files = dict(zip(target_names("objects", 2), (parties.candidate(2) / WEIGHTS, tmp_path / CANDIDATE), strict=True))
    sign_targets(parties, "image", files, None)
    sign_targets(parties, "director", files, EVERYBODY)
    refuses(parties, "a card of other weights")


def test_a_card_in_the_weights_that_was_not_described(parties: Parties, tmp_path: Path):
    own: Candidate = read_candidate(parties.candidate(2))
    (tmp_path / CANDIDATE).write_text(own.model_copy(update={"card": "0" * 64}).model_dump_json())
    files = dict(zip(target_names("objects", 2), (parties.candidate(2) / WEIGHTS, tmp_path / CANDIDATE), strict=True))
    sign_targets(parties, "image", files, None)
    sign_targets(parties, "director", files, EVERYBODY)
    refuses(parties, "hold a card of other weights")


def test_a_revoked_vehicle_installs_nothing(parties: Parties):
    parties.release("image", 2)
    parties.release("director", 2, Directive(release=2, share_ppm=ALL, vehicles=("cav0",), revoked=("cav0",)))
    parties.update()
    assert drives(parties) == 1
    stage_directive(parties.director, "objects", EVERYBODY, parties.keys("director", 1, 2))
    publish(parties.director)
    parties.update()
    assert drives(parties) == 2


def test_another_format_is_refused(parties: Parties, tmp_path: Path):
    (tmp_path / CANDIDATE).write_text(json.dumps({"format": "somebody-else-3"}))
    files = dict(zip(target_names("objects", 2), (parties.candidate(2) / WEIGHTS, tmp_path / CANDIDATE), strict=True))
    sign_targets(parties, "image", files, None)
    sign_targets(parties, "director", files, EVERYBODY)
    refuses(parties, "a bundle of the format 'somebody-else-3'")


def test_keys_of_one_party_twice(parties: Parties, tmp_path: Path):
    (own,) = parties.keys("image", 1)
    with pytest.raises(InputError, match="is given twice among the keys of the provider"):
        stage_release(parties.image, parties.candidate(2), [own, own])
    with pytest.raises(InputError, match="is given twice"):
        create_repository(tmp_path / "one", "customer", own=[own, own])
    create_repository(tmp_path / "director", "customer", own=parties.keys("image", 1, 2, 3))
    with pytest.raises(InputError, match="provider and customer together"):
        trust_roots(tmp_path / "car", read_root(parties.image), read_root(tmp_path / "director"))
    with pytest.raises(InputError, match="is not of the customer"):
        trust_roots(tmp_path / "car", read_root(parties.image), read_root(parties.image))


def test_the_clock_of_a_party_that_is_off(parties: Parties):
    yesterday = datetime.now(UTC) - timedelta(days=1)
    with pytest.raises(InputError, match="the clock is off"):
        publish(parties.image, now=yesterday)


# who was robbed: provider's keys, customer's keys, online keys -> other weights, other choice among releases
STOLEN = {
    "the provider's server": ((), (), ("image",), False, False),
    "the customer's server": ((), (), ("director",), False, False),
    "both servers": ((), (), ("image", "director"), False, False),
    "one key of each party and both servers": ((1,), (1,), ("image", "director"), False, False),
    "all keys of the provider and its server": ((1, 2, 3), (), ("image",), False, False),
    "all keys of the provider and both servers": ((1, 2, 3), (), ("image", "director"), False, False),
    "all keys of the customer and both servers": ((), (1, 2, 3), ("image", "director"), False, True),
    "two keys of both parties and both servers": ((1, 2), (1, 2), ("image", "director"), True, True),
}


def force(parties: Parties, party: str, online: bool) -> None:
    """Publish staged metadata as a thief does: whatever signatures they have, by the online key if it is stolen."""
    metadata, staged = (
        parties.folder / party / "repository" / "metadata",
        parties.folder / party / "staged" / "targets.json",
    )
    version = Metadata.from_file(str(staged)).signed.version
    shutil.copyfile(staged, metadata / f"{version}.targets.json")
    if online:
        timestamp = Metadata.from_file(str(metadata / "timestamp.json"))
        snapshot = Metadata.from_file(str(metadata / f"{timestamp.signed.snapshot_meta.version}.snapshot.json"))
        key = read_private_key(parties.folder / party / "keys" / "online.pem")
        sign_online(metadata, snapshot, timestamp, key, datetime.now(UTC), version)


@pytest.mark.parametrize("stolen", STOLEN)
def test_what_each_stolen_key_can_do(parties: Parties, stolen: str):
    provider, customer, online, other_weights, other_choice = STOLEN[stolen]
    parties.release("image", 2)  # acknowledged by the provider alone
    before = {party: (parties.folder / party / "repository", party in online) for party in ("image", "director")}
    chosen = Directive(release=2, share_ppm=ALL)
    stage_release(parties.director, parties.candidate(2), parties.keys("director", *customer), chosen)
    force(parties, "director", "director" in online)
    with contextlib.suppress(ReleaseRefused):
        parties.update()
    assert (drives(parties) == 2) == other_choice
    evil = parties.folder / "evil"
    shutil.copytree(parties.candidate(2), evil)
    described = read_candidate(evil).model_copy(update={"release": 3, "rolls_back": 2})
    (evil / CANDIDATE).write_text(described.model_dump_json())
    for party, keys in (("image", provider), ("director", customer)):
        directive = Directive(release=3, share_ppm=ALL) if party == "director" else None
        stage_release(parties.folder / party, evil, parties.keys(party, *keys), directive)
        force(parties, party, before[party][1])
    with contextlib.suppress(ReleaseRefused):
        parties.update()
    assert (drives(parties) == 3) == other_weights


def test_a_check_keeps_nothing_but_metadata(parties: Parties):
    parties.release("image", 2)
    parties.release("director", 2)
    checked = check_release(parties.vehicle, "cav0", parties.sources())
    assert checked.approved is not None
    assert checked.approved.release == 2
    assert drives(parties) == 1
    assert 0 < checked.metadata_bytes < 50_000
    assert load_targets(parties.director).signed.version == 3


def test_two_of_three_owners_sign_for_a_party(parties: Parties):
    for folder in (parties.image, parties.director):
        roles = load_root(folder).signed.roles
        owned = [(roles[name].threshold, len(roles[name].keyids)) for name in ("root", "targets")]
        assert owned == [(2, 3), (2, 3)]
        assert not {*roles["targets"].keyids} & {*roles["timestamp"].keyids}


def test_one_key_in_two_texts_is_one_owner(parties: Parties, tmp_path: Path):
    create_repository(tmp_path / "twin", "customer", keys=2, threshold=2)
    path = tmp_path / "twin" / "repository" / "metadata" / "1.root.json"
    root = Metadata.from_file(str(path))
    first, second = root.signed.roles["targets"].keyids
    key = root.signed.keys[first]
    twin = SSlibKey("twin", key.keytype, key.scheme, {"public": key.keyval["public"].rstrip("\n") + "\n\n"})
    for role in ("root", "targets"):
        root.signed.revoke_key(second, role)
        root.signed.add_key(twin, role)
    path.write_bytes(root.to_bytes())
    with pytest.raises(InputError, match="is given twice among the keys of a root"):
        trust_roots(tmp_path / "car", read_root(parties.image), read_root(tmp_path / "twin"))
    with pytest.raises(InputError, match="is given twice among the keys of a root"):
        publish(tmp_path / "twin")
    twin.keyval["public"] = "ssh-rsa AAAA"
    path.write_bytes(root.to_bytes())
    with pytest.raises(InputError, match="holds no public key"):
        trust_roots(tmp_path / "car", read_root(parties.image), read_root(tmp_path / "twin"))
    assert not (tmp_path / "car").exists()
