"""What a fleet's vehicles read of the releases on offer, and that they only read."""

import asyncio

import pytest

from flcav.fleet.proxy import RELEASES, answer_release
from flcav.fleet.relay import RelayRefused
from flcav.fleet.releases import ReleaseOffer, find_offered


def test_a_file_of_either_repository_is_found_and_none_without_an_offer(tmp_path):
    own = {party: tmp_path / f"{party} of others" for party in ("image", "director")}
    for party, folder in own.items():
        (folder / "metadata").mkdir(parents=True)
        (folder / "metadata" / "timestamp.json").write_text(party)
    (own["image"] / "metadata" / "way").symlink_to(tmp_path)
    fleet = tmp_path / "fleet"
    assert find_offered(fleet, "image/metadata/timestamp.json") is None
    ReleaseOffer(*map(str, own.values())).save(fleet)
    for party in own:
        found = find_offered(fleet, f"{party}/metadata/timestamp.json")
        assert found is not None
        assert found.read_text() == party
    assert find_offered(fleet, "image/targets/timestamp.json") is None
    with pytest.raises(ValueError, match="leads out of the repository"):
        find_offered(fleet, "image/metadata/way/secret")


@pytest.mark.parametrize("method", ["PUT", "DELETE", "HEAD", "POST"])
def test_releases_are_only_read(tmp_path, method: str):
    async def call() -> None:
        scope = {"path": f"{RELEASES}image/metadata/root.json", "method": method}
        await answer_release(tmp_path, "a", scope, None, None, lambda: 0)  # pyright: ignore

    with pytest.raises(RelayRefused, match="is no call of a vehicle's"):
        asyncio.run(call())
