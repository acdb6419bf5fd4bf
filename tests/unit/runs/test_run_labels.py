"""Labels without ground truth: from which score on, near which sensors, and what the road's cost."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flcav.config import InputError, parse_config
from flcav.fusion.distillation import Distillation
from flcav.geometry import Boxes
from flcav.perception.objects.truth import FrameTruth
from flcav.runs.analysis.caveats import PLACED_BARE, list_caveats
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import Names, resolve_settings
from flcav.runs.extras.distillation import sizes
from flcav.runs.extras.distillation.sizes import measure_messages
from flcav.runs.frames import Frames
from flcav.runs.label_sources import LABEL_SOURCES, choose_labels
from flcav.runs.labels import pseudo_labels
from flcav.runs.labels.pseudo_labels import fit_label_threshold, select_frames_near
from flcav.runs.recipe import RunRecipe
from flcav.runs.training.updates import RegionDrive, Sensors


def cars(*places: tuple[float, float]) -> Boxes:
    """Return cars ahead at x with a score."""
    rows = [(x, 0.0, 0.0, 4.0, 2.0, 1.6, 0.0) for x, _ in places]
    return Boxes.from_array(np.array(rows).reshape(-1, 7), "Car", [score for _, score in places])


@pytest.mark.parametrize(
    ("scores_of_hits", "scores_of_misses", "threshold"),
    [
        ([0.9, 0.8, 0.7], [], 0.7),
        ([0.9 - i / 100 for i in range(9)], [0.5], 0.5),  # 9 of 10 are right
        ([0.9 - i / 100 for i in range(9)], [0.5, 0.4], 0.5),
        ([0.9, 0.8], [0.85], 0.9),
        ([0.8], [0.9], 1.0),  # nothing is sure enough
        ([], [], 1.0),
    ],
)
def test_own_labels_start_where_nine_of_ten_are_right(
    scores_of_hits: list[float], scores_of_misses: list[float], threshold: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    hits = [(10.0 * i, score) for i, score in enumerate(scores_of_hits, start=1)]
    misses = [(-10.0 * i, score) for i, score in enumerate(scores_of_misses, start=1)]
    truth = FrameTruth("s", cars(*hits), Boxes.empty(), Boxes.empty())
    monkeypatch.setattr(pseudo_labels, "asked_of", lambda frame, config: truth)
    monkeypatch.setattr(pseudo_labels, "detect_in", lambda network, frames: [cars(*hits, *misses)])
    data = SimpleNamespace(frame=lambda i: SimpleNamespace(lidar={"lidar": None}, key="k"))
    split = Frames(cast(Any, data), (0,), {})
    assert fit_label_threshold(cast(Any, SimpleNamespace(config=None)), [split]) == threshold


def test_groups_are_the_vehicles_within_range_of_a_sensor() -> None:
    def frame(i: int) -> Any:
        pose = np.eye(4)
        pose[0, 3] = 10.0 * i
        return SimpleNamespace(world_from_agent=pose)

    split = Frames(cast(Any, SimpleNamespace(frame=frame)), tuple(range(10)), {})
    sites = np.array([[0.0, 0.0], [70.0, 0.0]])
    assert select_frames_near(split, sites, 15.0) == (0, 1, 6, 7, 8)
    assert select_frames_near(split, sites[:1], 35.0) == (0, 1, 2, 3)
    assert select_frames_near(split, sites[:0], 1.0) == split.vehicles


def test_every_kind_that_nobody_could_have_says_that_it_is_an_upper_bound() -> None:
    heard = ("messages", "tracks+messages", "road+tracks+messages")
    measured = ("own-detections", "road", "road-average", "tracks", "road+tracks", *heard)
    assert heard == tuple(name for name, kind in LABEL_SOURCES.items() if kind.heard)
    assert not any(LABEL_SOURCES[name].bound for name in measured)
    assert all(("upper bound" in kind.caveat) != (name in measured) for name, kind in LABEL_SOURCES.items())
    assert LABEL_SOURCES["road"].caveat != LABEL_SOURCES["ideal-road"].caveat  # reports show which it was
    assert choose_labels("objects", None) == "road"
    assert choose_labels("trajectory", None) == "future"
    with pytest.raises(InputError, match="labels of 'weather': 'ideal-road' is none of annotated"):
        choose_labels("weather", "ideal-road")


def test_the_road_detector_is_said_to_have_been_trained_where_it_labels() -> None:
    def caveats(kind: str, town: str, arm: str | None = None) -> tuple[str, ...]:
        recipe = RunRecipe.model_validate(
            {
                "tasks": {"objects": {"history": "objects", "labels": kind}},
                "regions": {"suburb": {"role": "pretrain"}, "here": {"town": town, "role": "federate"}},
                "budgets_mb": {"wireless": 1, "wireline": 1},
                "arms": {} if arm is None else {"other": {"labels": {"objects": arm}}},
            }
        )
        return list_caveats(recipe, (kind,), resolve_settings(recipe, {"objects": kind}).values())

    told = "the road detector was trained in here, so that its labels are better there than elsewhere"
    assert caveats("road", "grid") == ("trained road detector",)
    assert caveats("road", "arterial") == ("trained road detector", told)
    assert caveats("road-average", "hilly_suburb") == ("trained road detector", told)
    assert caveats("own-detections", "arterial") == ()
    assert caveats("own-detections", "arterial", arm="road") == (told,)


@pytest.mark.parametrize("hidden", [{"privacy": {"clip": 1, "noise": 1}}, {"secure": {}}])
def test_places_of_errors_are_said_to_be_sent_bare_where_updates_are_hidden(hidden: Any) -> None:
    def caveats(placed: Any, federation: Any, **arm: Any) -> tuple[str, ...]:
        recipe = RunRecipe.model_validate(
            {
                "tasks": {"objects": {"history": "objects"}},
                "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}},
                "budgets_mb": {"wireless": 1, "wireline": 1},
                "placement": placed,
                "arms": {"other": {"federation": federation, **arm}},
            }
        )
        return list_caveats(recipe, (), resolve_settings(recipe, {"objects": "own-detections"}).values())

    assert caveats({}, hidden) == (PLACED_BARE,)
    assert caveats({}, {}) == caveats({}, hidden, central="federate") == ()
    assert caveats({"rule": "none", "tasks": []}, hidden) == ()


def test_a_vehicle_s_messages_are_priced_for_all_spins_of_its_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    times_s = (0.0, 0.5, 1.0, 4.0)
    keys = [SimpleNamespace(scene="s", agent="cav0", index=i, time_s=time_s) for i, time_s in enumerate(times_s)]
    drive = Frames(cast(Any, SimpleNamespace(keys=keys)), (1, 3), {})
    monkeypatch.setattr(sizes, "_expect_sensors", lambda region, sensors: np.zeros((1, 2)))
    monkeypatch.setattr(sizes, "select_frames_near", lambda drive, sites, near_m: drive.vehicles)
    monkeypatch.setattr(sizes, "_sighting_bytes", lambda *about: 1000)

    def priced_mb(recorded: bool, window_s: float) -> float:
        region = RegionDrive(drive, recorded, training_frames=20, vehicles=2)
        sensors = Sensors((), 1, 40.0, 60.0)
        return measure_messages([region], sensors, Distillation(window_s=window_s), cast(Any, None))

    assert priced_mb(recorded=False, window_s=0.0) == pytest.approx(20 * 1e-3 / 2)
    assert priced_mb(recorded=False, window_s=0.5) == pytest.approx(3 * 20 * 1e-3 / 2)
    assert priced_mb(recorded=True, window_s=0.0) == pytest.approx(20 * 1e-3 / 2)
    assert priced_mb(recorded=True, window_s=0.5) == pytest.approx(2 * 20 * 1e-3 / 2)  # 4 frames told of for 2


def messages_recipe(labels: str, messages: Any = None, **arms: Any) -> RunRecipe:
    fields = {
        "tasks": {"objects": {"labels": labels, "plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 0}}},
        "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}},
        "budgets_mb": {"wireless": 100, "wireline": 80},
        "arms": {name: {"stages": ["edge"], **arm} for name, arm in arms.items()},
    }
    return parse_config(RunRecipe, fields | ({} if messages is None else {"messages": messages}), "run.yaml")


@pytest.mark.parametrize(
    ("messages", "arm", "said"),
    [
        ({"share": 1.5}, {}, r"^run.yaml: field 'messages.share' = 1.5: "),
        ({"share": -0.1}, {}, r"^run.yaml: field 'messages.share' = -0.1: "),
        ({"position_m": -0.5}, {}, r"^run.yaml: field 'messages.position_m' = -0.5: "),
        ({"lost": 2}, {}, r"^run.yaml: field 'messages.lost' = 2: "),
        (None, {"messages": {"share": 7}}, r"arms.other.messages: field 'share' = 7: "),
        (None, {"messages": {"shares": 0.7}}, r"arms.other.messages: .*shares"),
    ],
)
def test_impossible_messages_are_refused_in_a_sentence(messages: Any, arm: Any, said: str) -> None:
    with pytest.raises(InputError, match=said):
        messages_recipe("tracks+messages", messages, other=arm)


def test_messages_that_no_label_comes_from_are_refused() -> None:
    def check(recipe: RunRecipe) -> None:
        check_federations(recipe, resolve_settings(recipe).values())

    check(messages_recipe("tracks", {"share": 0.6}, other={"labels": {"objects": "messages"}}))
    check(messages_recipe("messages", None, other={"messages": {"share": 0.6}}, bare={"labels": {"objects": "tracks"}}))
    check(RunRecipe.model_validate(messages_recipe("tracks").model_dump()))  # with all fields, as results have it
    with pytest.raises(InputError, match=r"^messages: its labels are without messages; choose 'tracks\+messages'"):
        check(messages_recipe("tracks", {"share": 0.6}))
    with pytest.raises(InputError, match=r"^arms.other.messages: its labels are without messages"):
        check(messages_recipe("messages", None, other={"messages": {"share": 1}, "labels": {"objects": "tracks"}}))


def test_arms_with_other_messages_have_labels_of_their_own() -> None:
    recipe = messages_recipe("tracks+messages", None, same={}, more={"messages": {"share": 0.6}})
    names = Names(resolve_settings(recipe))
    for step in (names.tracks, names.edge):
        assert step("main", "grid", "objects") == step("same", "grid", "objects") != step("more", "grid", "objects")
    assert names.pretrain("more", "objects") == names.pretrain("main", "objects")
    told = {name: each.messages.share for name, each in resolve_settings(recipe).items()}
    assert told == {"main": 0.3, "same": 0.3, "more": 0.6}
