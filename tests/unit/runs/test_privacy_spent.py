"""Privacy that a vehicle spends in all trainings with its data, against an account of every participation."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dp_accounting import GaussianDpEvent, rdp

from flcav.config import InputError
from flcav.federation.privacy import SEEDED, Privacy, add_noise, measure_round_noise
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.runs.analysis.collect import list_trainings
from flcav.runs.arms import name_repeat
from flcav.runs.forecast import measure_noise
from flcav.runs.recipe import CLOUD, EDGE, MAIN, RunRecipe
from flcav.runs.results.training import PrivacySpent, StageResult
from flcav.runs.stages.graph import Graph
from flcav.runs.training.private_rounds import PrivateTraining, compose_trainings, plan_private_rounds

PRIVACY = {"clip": 1.0, "noise": 1.0}


def composed(participations: int) -> float:
    return rdp.RdpAccountant().compose(GaussianDpEvent(1.0), participations).get_epsilon(1e-5)


def test_tasks_and_retrainings_compose_and_do_not_add_up() -> None:
    rules = Rules(privacy=Privacy.model_validate(PRIVACY))
    one, four = (compose_trainings(rules, [PrivateTraining("grid", 4, 3)] * number) for number in (1, 4))
    assert one is not None
    assert four is not None
    assert (one.epsilon, four.epsilon) == pytest.approx((composed(3), composed(12)))
    assert f"{one.epsilon:.0f} {four.epsilon:.0f}" == "9 21"
    elsewhere = compose_trainings(
        rules, [PrivateTraining("grid", 4, 3), PrivateTraining("ring", 4, 3)]
    )  # other vehicles
    assert elsewhere == one
    assert compose_trainings(rules, [PrivateTraining("grid", 4, 0)]) is None
    assert compose_trainings(Rules(), [PrivateTraining("grid", 4, 3)]) is None
    assert one.describe() == f"epsilon {composed(3):.2f} at delta 1e-05"
    assert PrivacySpent(1.0, 1e-5, True).describe() == f"epsilon 1.00 at delta 1e-05 ({SEEDED})"


@pytest.mark.parametrize("selection", [Selection(), Selection(rule="round-robin", clients=2)])
def test_a_run_composes_all_that_its_vehicles_took_part_in(selection: Selection, tmp_path: Path) -> None:
    plan = {"samples": 2, "edge_rounds": 1, "cloud_rounds": 1}
    recipe = RunRecipe.model_validate(
        {
            "tasks": {"weather": {"plan": plan}, "signs": {"plan": plan}},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 3}},
            "budgets_mb": {"wireless": 90, "wireline": 90},
            "placement": {"rule": "none"},
            "retrainings": 1,
            "federation": {
                "privacy": PRIVACY,
                "edge_rounds_per_cloud_round": 2,
                "selection": selection.model_dump(exclude_defaults=True),
            },
        }
    )
    graph, taken = Graph(recipe, tmp_path), 0
    for task, edge, cloud in (("weather", 2, 3), ("signs", 1, 1)):
        for arm in (MAIN, name_repeat(MAIN, 1)):
            for stage, rounds in ((EDGE, edge), (CLOUD, cloud)):
                folder = tmp_path / graph.names.stage(arm, stage, "grid", task)
                folder.mkdir()
                StageResult(stage, task, "grid" if stage == EDGE else None, rounds, 9, 3, ()).save(folder)
            rounds = edge + 2 * cloud
            taken += rounds if selection.rule == "all" else math.ceil(rounds * 2 / 3)
    setting = graph.settings[MAIN]
    spent = compose_trainings(setting.federation, list_trainings(graph, tmp_path, setting))
    assert spent is not None
    assert spent.epsilon == pytest.approx(composed(taken))


def test_a_budget_is_shared_by_both_stages() -> None:
    rules = Rules(privacy=Privacy(noise=1.0))
    budgets = {n: composed(n) + 1e-6 for n in (12, 8, 7, 3, 1)}

    def plan(epsilon: float | None, edge: int, further: int, at_once: int) -> tuple[int, int]:
        asked = Rules(privacy=Privacy(noise=1.0, epsilon=epsilon))
        planned = plan_private_rounds(asked, [4, 3], edge, further, at_once)
        assert planned.rules == asked
        return planned.edge, planned.further

    assert plan_private_rounds(rules, [4], 6, 6, 2) == (rules, 6, 6)
    assert plan_private_rounds(Rules(), [4], 6, 6, 2) == (Rules(), 6, 6)
    assert plan(budgets[12], 6, 6, 2) == (6, 6)
    assert plan(budgets[8], 6, 6, 2) == (4, 4)
    assert plan(budgets[7], 6, 6, 2) == (5, 2)  # whole cloud rounds
    assert plan(budgets[3], 6, 6, 2) == (3, 0)
    assert plan(budgets[3], 2, 10, 1) == (1, 2)
    with pytest.raises(InputError, match="a first round comes to epsilon"):
        plan(budgets[1] / 2, 6, 6, 2)


@pytest.mark.slow
def test_a_budget_alone_gives_one_noise_for_all_regions() -> None:
    asked = Rules(privacy=Privacy(epsilon=6.0), selection=Selection(rule="uniform", clients=2))
    planned = plan_private_rounds(asked, [8, 4], 3, 4, 2)
    few, many = (plan_private_rounds(asked, [number], 3, 4, 2).rules.privacy for number in (4, 8))
    assert (planned.edge, planned.further, planned.rules.privacy) == (3, 4, few)  # each of four is drawn more often
    assert few is not None
    assert many is not None
    assert few.deviation > many.deviation
    spent = compose_trainings(
        asked, [PrivateTraining("grid", 8, 7, few.noise), PrivateTraining("ring", 4, 7, few.noise)]
    )
    assert spent is not None
    assert spent.epsilon <= 6
    assert spent.describe().endswith(f"at delta 1e-05, noise {few.noise:g} x clip")


@pytest.mark.parametrize(("where", "clients"), [("central", 3), ("local", 4)])
def test_the_noise_of_a_round_is_as_long_as_the_noise_that_is_drawn(where: Any, clients: int) -> None:
    privacy = Privacy(where=where, noise=0.7, clip=0.5, seeded=True)
    nothing = {"a": np.zeros((300, 100)), "b": np.zeros(2000)}
    drawn = [add_noise(nothing, privacy, seed, None) for seed in range(clients if where == "local" else 1)]
    length = math.sqrt(sum(float(np.square(sum(each[name] for each in drawn)).sum()) for name in nothing))
    found = measure_round_noise(privacy, clients, 32_000)
    assert found.norm == pytest.approx(length, rel=0.02)
    assert found.most == clients * 0.5


def test_noise_that_is_longer_than_the_updates_is_warned_of() -> None:
    ruinous = measure_round_noise(Privacy(noise=1.81), 3, 162_540)
    assert ruinous.drowns
    assert ruinous.describe().startswith(
        "WARNING: noise of a round 730 over 162,540 values, beside 3 at most of the clipped updates of 3 vehicles: 243 "
    )
    faint = measure_round_noise(Privacy(noise=0.005), 3, 162_540)
    assert not faint.drowns
    assert faint.describe() == (
        "noise of a round 2.02 over 162,540 values, beside 3 at most of the clipped updates of 3 vehicles"
    )


@pytest.mark.parametrize(
    ("federation", "clients", "values"),
    [
        ({}, 3, 61_836),
        ({"selection": {"rule": "poisson", "probability": 0.5}}, 1.5, 61_836),
        ({"upload": {"layers": ["*bias*"]}}, 3, 6 + 16 + 120 + 84 + 8),  # of the layers of LeNet-5
        ({"strategy": {"fedbuff": {"buffer": 2}}, "network": {}}, 2, 61_836),
    ],
)
def test_a_forecast_counts_the_values_that_are_sent_and_the_vehicles_of_a_round(
    federation: Any, clients: float, values: int, tmp_path: Path
) -> None:
    recipe = RunRecipe.model_validate(
        {
            "tasks": {"weather": {"plan": {"samples": 2, "edge_rounds": 1, "cloud_rounds": 1}, "train_s": 1.0}},
            "regions": {
                "suburb": {"role": "pretrain"},
                "grid": {"role": "federate", "vehicles": 5},
                "ring": {"role": "federate", "vehicles": 3},
            },
            "budgets_mb": {"wireless": 90, "wireline": 90},
            "placement": {"rule": "none"},
            "federation": {"privacy": PRIVACY, **federation},
        }
    )
    graph = Graph(recipe, tmp_path)
    arm = graph.settings[MAIN]
    found = measure_noise(graph, arm, "weather", arm.federation)
    assert found is not None
    assert (found.clients, found.values) == (clients, values)
