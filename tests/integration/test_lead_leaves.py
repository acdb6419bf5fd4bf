"""A whole stage II on the radio whose group has no edge server in range, and whose lead leaves in mid-round."""

from pathlib import Path

import pytest
import yaml

from flcav.network.ledger import Ledger
from flcav.runs.edge_stage import federate_regions
from flcav.runs.extras.groups.rows import LeadTerm
from flcav.runs.recipe import RunRecipe

DOCS = Path(__file__).parents[2] / "docs" / "groups.md"


def read_recipe() -> RunRecipe:
    """Return the recipe of an ad hoc group in the docs."""
    (found,) = (each for each in DOCS.read_text().split("```yaml\n") if "power_dbm" in each)
    return RunRecipe.model_validate(yaml.safe_load(found.partition("```")[0]))


@pytest.mark.slow
def test_the_next_lead_begins_the_round_again(tmp_path: Path) -> None:
    """By hand from the ledger: the lead gets one update, is out of coverage, and the next one asks the others anew."""
    (found,) = federate_regions(read_recipe(), tmp_path, jobs=1).federations
    group = found.result.group
    assert group is not None
    assert group.terms == (LeadTerm("grid/cav0", 1, 1, 1), LeadTerm("grid/cav1", 1))
    assert "grid/cav0 left in round 1 with 1 update, and the round began again" in group.describe()
    ledger = Ledger.load(tmp_path / "work" / "grid-federate-weather" / "ledger.parquet")
    network = [each for each in ledger if each.round == 1 and each.bytes > 100_000]
    before = [("down", "grid/cav1"), ("up", "grid/cav1"), ("down", "grid/cav2")]  # cav0 leads: its own crosses no link
    after = [("down", "grid/cav0"), ("down", "grid/cav2"), ("up", "grid/cav2"), ("down", "grid/cav3")]
    assert [(each.direction, each.client) for each in network] == before + after
    second = {each.client for each in ledger if each.round == 2 and each.bytes > 100_000}
    assert second == {"grid/cav0", "grid/cav2", "grid/cav3"}  # cav1 leads
