"""Lifelong learning: what is remembered, which network drives, when a condition is mended, and the steps' wiring."""

from pathlib import Path
from typing import Any

import pytest

from flcav.config import InputError, parse_config
from flcav.network.ledger import Ledger, LedgerEntry, LinkMegabytes
from flcav.runs.arm_checks import check_federations
from flcav.runs.extras.groups.rows import CheckedNetwork, Group
from flcav.runs.extras.lifelong.replay import NO_LIMIT, divide_memory, spread_evenly
from flcav.runs.extras.lifelong.results import find_mended
from flcav.runs.extras.lifelong.rows import LifelongArm, Passed
from flcav.runs.extras.lifelong.steps import (
    ReplaySettings,
    compare_copies,
    forecast_lifelong_s,
    name_driving,
    name_learning,
)
from flcav.runs.frames import Joined
from flcav.runs.recipe import RunRecipe
from flcav.runs.stages.federating import EdgeSettings
from flcav.runs.stages.graph import Graph

VALUES: dict[str, Any] = {
    "size": "toy",
    "tasks": {"objects": {"network": "pillars", "labels": "annotated", "plan": {
        "samples": 4, "edge_rounds": 2, "cloud_rounds": 0}}},
    "regions": {
        "suburb": {"role": "pretrain"},
        **{name: {"role": "federate", "town": "grid", "vehicles": 2, "recording": {"weather": weather}}
           for name, weather in (("sun", "clear"), ("fog", "fog"), ("rain", "heavy_rain"))},
    },
    "budgets_mb": {"wireless": 90, "wireline": 40},
    "placement": {"rule": "none"},
    "lifelong": {"conditions": ["sun", "fog", "rain"], "memory": 5, "requests": {"excess": 2.0}},
}  # fmt: skip


def recipe(**changes: Any) -> RunRecipe:
    return parse_config(RunRecipe, VALUES | changes, "recipe")


def test_memory_is_divided_as_equally_as_it_goes() -> None:
    for frames in (1, 5, 12):
        for conditions in (1, 2, 3, 7):
            shares = divide_memory(frames, conditions)
            assert (sum(shares), len(shares)) == (frames, conditions)
            assert max(shares) - min(shares) <= 1
    assert spread_evenly(10, 3) == [1, 5, 8]
    assert spread_evenly(2, 3) == [0, 1]
    assert spread_evenly(4, 0) == []


def test_joined_samples_are_those_of_the_parts_in_order() -> None:
    joined = Joined(["ab", "", "cde"])
    assert (len(joined), [*joined], joined[-1], joined[1:3]) == (5, [*"abcde"], "e", ["b", "c"])


def checked(before: float, after: float | None, held: int = 2) -> CheckedNetwork:
    return CheckedNetwork(held, before, after)


def test_a_copy_is_compared_on_what_its_members_held_back() -> None:
    vehicles = {"a": checked(1.0, 0.5), "b": checked(0.4, 0.6), "c": checked(9.0, None), "d": checked(5.0, 0.0, held=0)}
    assert compare_copies(Group(1.0, vehicles, "pole1", ("a", "b", "d"))) == pytest.approx((0.7, 0.55))
    assert compare_copies(Group(1.0, {"c": checked(9.0, None)}, "")) is None


@pytest.mark.parametrize(
    ("scores", "rounds_s", "replaced", "found"),
    [
        ((0.3, 0.4, 0.6, 0.7), (2.0, 3.0, 4.0), True, (15.0, 19.0)),  # after the second of three rounds, and all
        ((0.3, 0.4, 0.6, 0.7), (2.0, 3.0, 4.0), False, (15.0, None)),  # the copy never drove
        ((0.3, 0.6, 0.4), (2.0, 3.0), True, (12.0, None)),  # and was worse again in the end
        ((0.3, 0.4), (2.0,), True, (None, None)),
        ((0.6,), (), False, (0.0, 0.0)),  # the network that drives does
        ((0.6, 0.4), (2.0,), True, (0.0, None)),  # and was replaced by a worse one
        ((0.3, 0.7), None, True, (None, None)),  # no clock
    ],
)
def test_a_condition_is_mended_when_a_good_enough_network_drives(
    scores: tuple[float, ...], rounds_s: tuple[float, ...] | None, replaced: bool, found: tuple[float | None, ...]
) -> None:
    assert find_mended(scores, 0.5, 10.0, rounds_s, replaced) == found


def passed(learned_s: float | None, mended_s: float | None) -> Passed:
    return Passed("fog", (), 0, 0, False, {}, 0.5, 8.0, learned_s, mended_s, 10, 20)


def test_an_arm_counts_conditions_with_errors_and_those_mended() -> None:
    own = (passed(0.0, 0.0), passed(12.0, 19.0), passed(None, None))
    arm = LifelongArm.of("replay", "objects", "AP50", ((0.1,) * 3,) * 4, own)
    assert (len(arm.broken), arm.mended, arm.up_bytes, arm.down_bytes) == (2, (19.0,), 30, 60)
    assert arm.describe().endswith("1 of 2 conditions with errors mended, after 19 s")


def test_each_condition_goes_on_from_the_network_that_drives() -> None:
    steps = {step.name: step for step in Graph(recipe(), Path()).steps}
    for arm in ("replay", "no replay"):
        drives = "pretrain-objects"
        for number, condition in enumerate(("sun", "fog", "rain")):
            learned: ReplaySettings = steps[name_learning(condition, "objects", arm)].arguments["settings"]
            assert learned.inputs.pretrain == drives
            assert learned.federation.requests is not None
            assert learned.federation.requests.excess == 2.0
            remembered = () if learned.memory is None else learned.memory.conditions
            assert [each.region for each in remembered] == ["sun", "fog", "rain"][: number if arm == "replay" else 0]
            assert {f"rounds-{name_learning(condition, 'objects', arm)}-sun"} <= {*steps}
            drives = name_driving(condition, "objects", arm)
            assert {f"test-{drives}-{each}" for each in ("sun", "fog", "rain")} <= {*steps}
    own: EdgeSettings = steps["fog-edge-fl-objects"].arguments["settings"]  # what the condition can reach
    assert (own.inputs.pretrain, own.federation.requests) == ("pretrain-objects", None)


def test_labels_by_tracks_are_those_of_the_network_that_drives() -> None:
    tracked = {"objects": {**VALUES["tasks"]["objects"], "labels": "tracks"}}
    steps = {step.name: step for step in Graph(recipe(tasks=tracked), Path()).steps}
    learned: EdgeSettings = steps[name_learning("fog", "objects", "replay")].arguments["settings"]
    assert learned.inputs.tracks == "fog-tracks-objects-replay"
    assert name_driving("sun", "objects", "replay") in steps["fog-tracks-objects-replay"].needs


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"lifelong": {"conditions": ["sun", "suburb"]}}, "lifelong.conditions: 'suburb' is none of sun, fog, rain"),
        ({"lifelong": {"conditions": ["sun", "sun"]}}, "one of them comes twice"),
        ({"lifelong": {"conditions": ["sun"]}}, "conditions"),
        ({"lifelong": {"conditions": ["sun", "fog"], "memory": 0}}, "memory"),
        ({"lifelong": {"conditions": ["sun", "fog"], "requests": {"excess": -1}}}, "lifelong.requests"),
        ({"lifelong": {"conditions": ["sun", "fog"], "requests": {"exces": 1}}}, "exces"),
    ],
)
def test_what_cannot_be_is_told_in_one_sentence(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told) as error:
        recipe(**changes)
    assert "\n" not in str(error.value)


def test_a_roster_that_has_to_be_known_is_refused() -> None:
    asked = recipe(federation={"secure": {}})
    with pytest.raises(InputError, match="requests: how many vehicles a group has is not known before"):
        check_federations(asked, Graph(asked, Path()).settings.values())


def test_memories_are_labelled_without_a_budget() -> None:
    entry = LedgerEntry("edge", "objects", "wireless", "up", 0, "sun/cav0", 10**12)
    assert Ledger(NO_LIMIT, [entry]).left_mb("wireless") > 0
    with pytest.raises(InputError):
        Ledger(LinkMegabytes(1.0, 1.0), [entry])


def test_a_forecast_counts_the_rounds_and_scores_of_both_arms() -> None:
    """By hand: three conditions of two vehicles, two rounds of one step; toy sizes of tests and validations."""
    asked = recipe()
    assert asked.lifelong is not None
    graph, splits = Graph(asked, Path()), asked.sized_splits
    tests, validations = (each.scenes * each.spins * each.cavs for each in (splits.test, splits.validation))
    found = forecast_lifelong_s(graph, "objects", 2, 100.0, 1.0)
    assert found == 2 * (100.0 * 2 * 3 * 2 + 9 * tests + (1 + 2 + 3) * 3 * validations)
