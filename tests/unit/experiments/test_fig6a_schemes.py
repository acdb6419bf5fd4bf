"""Fig. 6a from the committed results: each row is the number that its study's page has."""

import json
from pathlib import Path

import pytest

from flcav.reproductions.fig6a.run import STEPS, Listed, Paired, Stored, read_steps, tabulate_schemes
from flcav.statistics.seeds import mean_over_seeds
from flcav.storage.records import to_json

REPRODUCTIONS = Path(__file__).parents[3] / "reproductions"


def test_rows_are_those_of_the_studies() -> None:
    found = read_steps(REPRODUCTIONS).differences
    assert found["edge FL - pretraining in the cloud"].describe(sign=True) == "+0.169 (+0.133 to +0.205)"
    assert found["VRCSP pole - densest pole"].describe(sign=True) == "+0.019 (+0.002 to +0.037)"
    assert found["VRCSP pole - no road sensor"].describe(sign=True) == "+0.025 (+0.010 to +0.041)"
    assert found["edge + cloud FL - edge FL, in grid"].describe(sign=True) == "-0.145 (-0.182 to -0.108)"
    trained = found["joint plan - equal stages, 80 MB + 20 MB, after edge FL"]
    assert (trained.describe(sign=True), trained.seeds) == ("+0.046 (+0.025 to +0.066)", 6)
    table = tabulate_schemes(read_steps(REPRODUCTIONS))["schemes"]
    assert all(step.name in table for step in STEPS)


def test_a_difference_is_read_or_paired_by_seed(tmp_path: Path) -> None:
    mean = mean_over_seeds([0.1, 0.2])
    seeds = {"1": {"a": [0.5, 0.7], "b": 0.4}, "2": {"a": [0.5, 0.9], "b": 0.5}}
    stored = to_json(mean, type(mean))
    (tmp_path / "result.json").write_text(json.dumps({"seeds": seeds, "differences": {"x": stored}}))
    assert Stored(("differences", "x")).read(tmp_path) == mean
    paired = Paired(("a", -1), ("b",)).read(tmp_path)
    assert (paired.mean, paired.seeds) == (pytest.approx(0.35), 2)


def test_a_difference_of_seeds_is_found_by_its_name() -> None:
    folder = REPRODUCTIONS / "runs" / "demo"
    assert Listed("ring, objects: edge + cloud FL - edge FL").read(folder).mean == pytest.approx(-0.056, abs=5e-4)
