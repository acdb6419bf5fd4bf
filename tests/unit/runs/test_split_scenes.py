"""Which scenes a split of a recorded dataset has: no scene is in two splits, and every scene is in one."""

from collections.abc import Collection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from test_run_recipe import parsed

from flcav.config import InputError
from flcav.runs import frames
from flcav.runs.frames import deal_frames, make_recording_recipe
from flcav.runs.recipe import SPLITS_OF, Role, RunRecipe, SplitName
from flcav.runs.stages.recording import RecordSettings
from flcav.sources.recipe import CarlaRecipe


class Recording:
    """A dataset of so many scenes, with two spins of a vehicle and of a roadside sensor in each."""

    folder = Path("data")

    def __init__(self, scenes: int) -> None:
        self.keys = [
            SimpleNamespace(scene=f"scene{scene:02}", agent=agent, index=index, time_s=float(index))
            for scene in range(scenes)
            for index in range(2)
            for agent in ("cav0", "pole3")
        ]

    def select(self, scenes: Collection[str] | None = None) -> list[int]:
        return [i for i, key in enumerate(self.keys) if scenes is None or key.scene in scenes]


def dealt(monkeypatch: pytest.MonkeyPatch, scenes: int, role: Role, seed: int = 1) -> dict[SplitName, set[str]]:
    data = Recording(scenes)
    monkeypatch.setattr(frames.Dataset, "open", lambda path: data)
    found: dict[SplitName, set[str]] = {}
    for split in SPLITS_OF[role]:
        own = deal_frames(Path("data"), split, role, seed, whole=False)
        numbers = [*own.vehicles, *(i for pole in own.poles.values() for i in pole)]
        found[split] = {data.keys[i].scene for i in numbers}
        assert own.scenes == len(found[split])
        assert len(numbers) == 4 * own.scenes
    return found


@pytest.mark.parametrize("role", SPLITS_OF)
def test_no_scene_is_in_two_splits_and_none_is_left_out(monkeypatch: pytest.MonkeyPatch, role: Role) -> None:
    least = len(SPLITS_OF[role]) + 1
    for scenes in range(least, 41):
        found = dealt(monkeypatch, scenes, role)
        assert sum(map(len, found.values())) == scenes
        assert len(set.union(*found.values())) == scenes
        assert all(len(own) >= (2 if split == "test" else 1) for split, own in found.items())


@pytest.mark.parametrize("role", SPLITS_OF)
def test_too_few_scenes_are_refused_in_a_sentence(monkeypatch: pytest.MonkeyPatch, role: Role) -> None:
    least = len(SPLITS_OF[role]) + 1
    with pytest.raises(InputError, match=f"data: {least - 1} scenes; at least {least} are wanted to deal to .* {role}"):
        dealt(monkeypatch, least - 1, role)


def test_scenes_are_dealt_by_the_seed_in_the_shares_of_the_splits(monkeypatch: pytest.MonkeyPatch) -> None:
    first, again, other = (dealt(monkeypatch, 100, "federate", seed) for seed in (1, 1, 2))
    assert first == again
    assert first != other
    assert {split: len(own) for split, own in first.items()} == {
        "validation": 15,
        "registry": 20,
        "edge": 39,
        "test": 26,
    }


def test_simulated_splits_have_traffic_of_their_own_and_another_draw_renews_the_test_alone() -> None:
    def seeds(**changes: Any) -> dict[tuple[str, str], int]:
        recipe = parsed(**changes)
        return {
            (region, split): make_recording_recipe(recipe, region, split, "objects", "recording").seed
            for region, own in recipe.regions.items()
            for split in SPLITS_OF[own.role]
        }

    first, redrawn, other = seeds(), seeds(test_draw=1), seeds(seed=2)
    assert len(set(first.values())) == len(first)
    assert {key[1] for key in first if first[key] != redrawn[key]} == {"test"}
    assert all(first[key] == redrawn[key] for key in first if key[1] != "test")
    assert all(first[key] != other[key] for key in first)


def test_a_region_may_be_recorded_from_carla() -> None:
    """Its step keeps the server through the JSON of its settings; another region's is of the built-in simulator."""
    fields = {"source": "carla", "port": 2100, "vehicles": 5}
    recipe = RunRecipe.model_validate(
        {
            "tasks": {"objects": {"plan": {"samples": 2, "edge_rounds": 1, "cloud_rounds": 0}}},
            "regions": {
                "suburb": {"role": "pretrain"},
                "grid": {"role": "federate", "recording": {**fields, "vehicle_rig": "lidar32"}},
            },
            "budgets_mb": {"wireless": 3, "wireline": 3},
        }
    )
    made = {name: make_recording_recipe(recipe, name, "test", "objects", "x") for name in ("suburb", "grid")}
    assert [type(each).__name__ for each in made.values()] == ["Recipe", "CarlaRecipe"]
    settings = RecordSettings(recipe=made["grid"], beside="", places=(), version={})
    again = RecordSettings.model_validate_json(settings.model_dump_json()).recipe
    assert isinstance(again, CarlaRecipe)
    assert (again.port, again.vehicles, again.town) == (2100, 5, "grid")
    assert (
        "source" not in RecordSettings(recipe=made["suburb"], beside="", places=(), version={}).model_dump()["recipe"]
    )
