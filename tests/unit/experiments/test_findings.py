import copy

from flcav.experiments.findings import findings
from flcav.verdicts import HELD, NOT_HELD, UNDECIDED

RESULTS = {
    "test_frames": 96,
    "test_scenes": 8,
    "stages": [{"town": "grid", "ap50": 0.412}, {"town": "grid", "ap50": 0.503}, {"town": "grid", "ap50": 0.495}],
    "differences": {
        "edge_minus_pretrained": {"mean": 0.091, "low": 0.055, "high": 0.127},
        "cloud_minus_edge": {"mean": -0.008, "low": -0.027, "high": 0.012},
    },
    "placement": {
        "chosen": 2,
        "densest": 8,
        "ap50_chosen": 0.503,
        "ap50_densest": 0.544,
        "difference": {"mean": -0.041, "low": -0.06, "high": -0.02},
    },
}


def test_each_finding_tells_its_own_numbers_frames_and_verdict() -> None:
    edge, cloud, pole = findings(RESULTS)
    assert [edge["verdict"], cloud["verdict"], pole["verdict"]] == [HELD, UNDECIDED, NOT_HELD]
    assert "from 0.412 to 0.503: +0.091, 95 % interval +0.055 to +0.127" in edge["sentence"]
    assert "held in this run" in edge["sentence"]
    assert "from 0.503 to 0.495: −0.008, 95 % interval −0.027 to +0.012" in cloud["sentence"]
    assert "contains 0, so this run does not decide" in cloud["sentence"]
    assert "0.503 with pole 2" in pole["sentence"]
    assert "0.544 with pole 8" in pole["sentence"]
    assert "did not hold in this run" in pole["sentence"]
    for finding in (edge, cloud, pole):
        assert "96 test frames of 8 scenes" in finding["sentence"]
        assert "ideal road detector, upper bound" in finding["sentence"]


def test_a_densest_pole_that_was_chosen_leaves_nothing_to_compare() -> None:
    results = copy.deepcopy(RESULTS)
    results["placement"] |= {"densest": 2, "difference": {"mean": 0.0, "low": 0.0, "high": 0.0}}
    pole = findings(results)[2]
    assert pole["verdict"] == UNDECIDED
    assert "nothing to compare" in pole["sentence"]
