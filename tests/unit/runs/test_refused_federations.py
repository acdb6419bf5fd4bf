"""Federations of a recipe that are refused before anything is computed, each in a sentence."""

import sys
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import pytest
from federated_recipes import PRIVACY, settings
from pydantic import ValidationError

from flcav.config import InputError
from flcav.fusion.distillation import Distillation
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import resolve_settings
from flcav.runs.recipe import Arm


@pytest.mark.parametrize(
    ("federation", "said"),
    [
        ({"strategy": "fedprose"}, "strategy 'fedprose': choose one of fedavg, "),
        ({"strategy": "krum"}, "krum: 5 clients or more are wanted .* and there are 4"),
        (
            {"strategy": {"median": {}}, "cloud_strategy": "krum"},
            "cloud_strategy, among edge servers: krum: .* and there are 2",
        ),
        (
            {"strategy": {"krum": {"byzantine": 0}}},
            r"cloud_strategy \(that of 'strategy', as none is given\), among edge servers: krum: .* and there are 2",
        ),
        ({"cloud_strategy": "fedprox"}, "cloud_strategy: FedProx corrects local steps, and edge servers take none"),
        (
            {"selection": {"rule": "uniform", "clients": 5}},
            "selection: 5 clients are wanted in a round, and there are 4",
        ),
        (
            {"selection": {"rule": "deadline", "deadline_s": 1, "seconds": {"cav0": 9, "grid/cav1": 9}}},
            "selection: 'seconds' has no time of a round for 4 of 5 clients, such as grid/cav0",
        ),
        ({"least_clients": 5}, "least_clients: 5 are wanted in a round, and 4 take part"),
        ({"cloud_strategy": "fedmd"}, "cloud_strategy: FedMD shares frames among vehicles, and edge servers have no"),
        ({"strategy": "fedmd"}, "strategy fedmd: 'objects' has no class probabilities .*; weather and signs have"),
        ({"strategy": {"fedmd": {"frames": 0}}}, "strategy 'fedmd': frames = 0: "),
        ({"personal": ["tail.*"]}, "personal: 'tail.\\*' matches none of [0-9]+ arrays, such as '"),
        ({"personal": ["*"]}, "personal: \\* leave nothing for the regions to average"),
        ({"personal": {"pull": 1}, "strategy": "fedprox"}, "FedProx corrects local steps, and so does the pull"),
        ({"upload": {"layers": ["tail.*"]}}, "layers: 'tail.\\*' matches none of [0-9]+ arrays, such as '"),
    ],
)
def test_an_impossible_federation_is_one_sentence_before_the_run(federation: Any, said: str) -> None:
    for arm, (recipe, arms) in {
        "": settings({}, **federation),
        "arm 'other': ": settings({"other": federation}),
    }.items():
        with pytest.raises(InputError, match=f"^{arm}{said}"):
            check_federations(recipe, arms)


def test_sweeps_are_not_compressed_where_a_task_has_none() -> None:
    recipe, _ = settings({})
    few = recipe.tasks["objects"].model_copy(update={"labels": None})
    arms = {"few": Arm(central="federate", uploads=3, compressed=True)}
    for tasks in ({"objects": few}, {"objects": few, "signs": few.model_copy(update={"network": None})}):
        own = recipe.model_copy(update={"tasks": tasks, "arms": arms})
        with pytest.raises(InputError, match="'signs' uploads none") if "signs" in tasks else nullcontext():
            check_federations(own, resolve_settings(own).values())


def test_what_needs_a_known_number_is_refused_where_the_plan_says_who_joins() -> None:
    def check(secure: dict[str, Any], *changes: dict[str, Any], **federation: Any) -> None:
        recipe, _ = settings({"masked": secure}, **federation)
        for more in changes:
            recipe = recipe.model_copy(update=more)
        check_federations(recipe, resolve_settings(recipe, {"objects": "ideal-road"}).values())

    regions = settings({})[0].regions
    slow = {"regions": {**regions, "grid": regions["grid"].model_copy(update={"speed": {"cav1": 0.5}})}}
    soon = {"horizon_s": 40.0}
    planned: dict[str, dict[str, Any]] = {
        "secure aggregation takes two or more": {"secure": {}},
        "noise is for one number": {"privacy": PRIVACY},
        "Krum needs a known one": {"strategy": {"krum": {"byzantine": 0}}, "cloud_strategy": "fedavg"},
    }
    for told, asked in planned.items():
        said = rf"horizon_s: a plan by .* leaves other numbers of vehicles .*{told}.*; choose another 'selection'"
        with pytest.raises(InputError, match=said):
            check(asked, slow, soon)
        with pytest.raises(InputError, match=said):
            check(asked | {"network": {}}, soon, network={})
        check(asked, slow)  # without a horizon all join every round
        check(asked, soon)
        check(asked | {"selection": {"rule": "round-robin", "clients": 3}}, slow, soon)
        arms = {"masked": Arm(plan="equal-stages", federation=asked)}
        check({}, slow, soon, {"arms": arms})
    check({"strategy": "median"}, slow, soon)  # of any number


@pytest.mark.parametrize(
    ("federation", "said"),
    [
        (
            {"strategy": {"trimmed-mean": {"fraction": 0.3}}, "cloud_strategy": "fedavg"},
            "and TrimmedMean needs a known one",
        ),
        ({"privacy": PRIVACY}, "and noise is for one number"),
        ({"strategy": "median"}, None),
        ({"secure": {}}, None),  # a round with too few has no update
    ],
)
def test_a_predicted_deadline_is_refused_with_what_needs_a_known_number(federation: Any, said: str | None) -> None:
    deadline, vehicles = {"rule": "deadline", "deadline_s": 9}, {"grid": 5, "ring": 4}
    seconds = {f"{region}/cav{i}": 1.0 for region, count in vehicles.items() for i in range(count)}

    def check(selection: dict[str, Any], **network: Any) -> None:
        check_federations(*settings({}, **federation, selection=selection, **network))

    with (
        nullcontext() if said is None else pytest.raises(InputError, match=f"federation.network: a predicted .* {said}")
    ):
        check(deadline, network={})
    check(deadline | {"seconds": seconds}, network={})
    check(deadline | {"seconds": seconds})
    with pytest.raises(
        InputError, match="selection: a deadline needs the predicted 'seconds' of a round by client, or"
    ):
        check(deadline)


def test_a_pose_graph_without_gtsam_is_refused_before_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, arms = settings({})
    check_federations(recipe, arms)
    graphs = [replace(each, distillation=Distillation(pose_graph=True)) for each in arms]
    monkeypatch.setitem(sys.modules, "gtsam", None)
    check_federations(recipe, arms)
    with pytest.raises(InputError, match="a pose graph needs GTSAM, which is in"):
        check_federations(recipe, graphs)


@pytest.mark.parametrize(
    ("federation", "said"),
    [
        ({"privacy": {**PRIVACY, "epsilon": 0}}, "privacy.epsilon"),
        ({"selection": {"rule": "uniform"}}, "the rule uniform needs 'clients'"),
        ({"upload": {"compression": "zip"}}, "upload.compression"),
    ],
)
def test_an_arm_s_rules_are_checked_with_the_recipe(federation: Any, said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        settings({"other": federation})


def test_a_budget_below_one_round_is_refused_with_the_recipe() -> None:
    small, large = ({"privacy": PRIVACY | {"epsilon": epsilon}} for epsilon in (0.5, 1.5))
    check_federations(*settings({"other": large}))
    with pytest.raises(InputError, match=r"privacy: a first round comes to epsilon = .*, above the budget of 0.5;"):
        check_federations(*settings({"other": small}))
    amplified = {"selection": {"rule": "poisson", "probability": 0.1}}
    check_federations(*settings({"other": small | amplified}))


@pytest.mark.parametrize(
    ("federation", "said"),
    [
        ({"privacy": PRIVACY}, "privacy"),
        ({"privacy": PRIVACY | {"where": "local"}}, "privacy"),
        ({"secure": {}}, "secure"),
        ({"secure": {}, "privacy": PRIVACY | {"where": "local"}}, "privacy"),
    ],
)
def test_labels_that_vehicles_make_together_are_refused_where_updates_are_hidden(federation: Any, said: str) -> None:
    recipe, _ = settings({"other": federation})
    for kind in ("ideal-road", "road"):  # boxes of the road alone
        check_federations(recipe, resolve_settings(recipe, {"objects": kind}).values())
    averaged = resolve_settings(recipe, {"objects": "road-average"}).values()
    with pytest.raises(InputError, match=rf"arm 'other': {said}: with the labels 'road-average' of objects each vehi"):
        check_federations(recipe, averaged)
    check_federations(recipe, [replace(each, central="federate") for each in averaged])


def test_what_is_drawn_late_or_in_secret_cannot_be_driven() -> None:
    poisson, privacy = {"rule": "poisson", "probability": 0.5}, {"clip": 1, "noise": 1}
    for federation, said in (
        ({"selection": {"rule": "importance", "clients": 1}}, "importance selection draws the clients after"),
        ({"selection": {"rule": "deadline", "deadline_s": 9}, "privacy": privacy}, "noise is for one number"),
        ({"selection": poisson, "privacy": privacy}, "poisson selection under central noise draws in secret"),
        ({"selection": {"rule": "uniform", "clients": 2}, "privacy": privacy}, "uniform selection under central noise"),
        ({"selection": poisson, "privacy": privacy | {"seeded": True}}, None),
        ({"selection": poisson, "privacy": privacy | {"where": "local"}}, None),  # whose draws are no secret
    ):
        refused = nullcontext() if said is None else pytest.raises(InputError, match=f"federation.network: .*{said}")
        with refused:
            check_federations(*settings({}, network={}, **federation))
