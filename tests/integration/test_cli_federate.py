"""`flcav federate`: what cannot federate is refused in one sentence, before anything is recorded."""

from pathlib import Path

import pytest
import yaml

from flcav.cli.main import run as command

RECIPE = {
    "tasks": {"weather": {"plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}}},
    "regions": {"suburb": {"role": "pretrain"}, "ring": {"role": "federate", "vehicles": 4}},
    "budgets_mb": {"wireless": 9, "wireline": 9},
    "placement": {"rule": "none"},
    "arms": {"oracle": {"central": "federate"}},
}


@pytest.mark.parametrize(
    ("federation", "sentence"),
    [
        ({"strategy": "fedbest"}, "strategy 'fedbest': choose one of fedavg, fedprox, "),
        ({"strategy": {"fedprox": {"mu": -1}}}, "strategy 'fedprox': mu = -1"),
        ({"strategy": "krum", "secure": {}}, "krum: 5 clients or more are wanted for byzantine = 1"),
        ({"strategy": "median", "secure": {}}, "Median looks at each update, and secure aggregation shows their sum"),
        (
            {"privacy": {"clip": 1, "noise": 1, "epsilon": 0}},
            "'federation.privacy.epsilon' = 0: Input should be greater",
        ),
        (
            {"privacy": {"clip": 1, "noise": 1, "epsilon": 0.01}},
            "privacy: a first round comes to epsilon = 4.729 at delta = 1e-05, above the budget of 0.01",
        ),
        ({"privacy": {"clip": 1, "noise": 0}}, "'federation.privacy.noise' = 0: Input should be greater than 0"),
        ({"selection": {"rule": "uniform", "clients": 5}}, "5 clients are wanted in a round, and there are 4"),
        ({"least_clients": 5}, "least_clients: 5 are wanted in a round, and 4 take part"),
        ({"least_clients": "half"}, "'federation.least_clients' = 'half': expected 'all' or a whole number from 1 to"),
        ({"strategy": {"fedprox": None}}, "field 'federation.strategy.fedprox' is empty"),
        ({"personal": {"pull": -1}}, "'federation.personal.RegionalModels.pull' = -1: Input should be greater than or"),
        ({"upload": {"compression": "int8", "fraction": 0.5}}, "the compression int8 takes no 'fraction'"),
        ({"least_clients": 0}, "'federation.least_clients' = 0: expected 'all' or a whole number from 1 to 1000000"),
    ],
)
def test_a_federation_that_cannot_be_is_refused_in_a_sentence(
    federation: dict, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "run.yaml", tmp_path / "out"
    path.write_text(yaml.safe_dump(RECIPE | {"federation": federation}))
    assert federate(path, out) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("arm", "sentence"), [("densest", "--arm densest: the recipe has main, oracle"), ("oracle", "trains centrally")]
)
def test_an_arm_without_a_federation_is_refused(
    arm: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump(RECIPE))
    assert federate(path, tmp_path / "out", "--arm", arm) == 2
    assert sentence in capsys.readouterr().err


def test_labels_that_are_renewed_are_refused_on_ray_before_anything_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "run.yaml", tmp_path / "out"
    objects = {"network": "tiny", "labels": "road-average", "plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 0}}
    path.write_text(yaml.safe_dump(RECIPE | {"tasks": {"objects": objects}, "placement": {"range_m": 40}}))
    assert federate(path, out, "--runtime", "ray") == 2
    assert "labels 'road-average' are renewed between rounds" in capsys.readouterr().err
    assert not out.exists()


def federate(recipe: Path, out: Path, *more: str) -> object:
    with pytest.raises(SystemExit) as stopped:
        command(["federate", str(recipe), "--out", str(out), *more])
    return stopped.value.code
