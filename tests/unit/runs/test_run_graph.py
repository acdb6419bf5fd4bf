"""The steps of a run: their order, and what arms share."""

from pathlib import Path
from typing import Any

import pytest

from flcav.config import InputError
from flcav.runs.engine import Step
from flcav.runs.recipe import MAIN, RunRecipe, load_run_recipe
from flcav.runs.stages.graph import Graph
from flcav.runs.stages.planning import UploadSettings
from flcav.sources.recipe import recipe_path

OBJECTS = {"objects": {"history": "objects"}}
TRACKED = {"objects": {"history": "objects", "labels": "tracks"}}
SEVERAL = {
    "objects": {"history": "objects"},
    **{name: {"plan": {"samples": 20, "edge_rounds": 1, "cloud_rounds": 1}} for name in ("signs", "trajectory")},
}


def recipe_of(**changes: Any) -> RunRecipe:
    return RunRecipe.model_validate(
        {
            "tasks": OBJECTS,
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}, "arterial": {"role": "unseen"}},
            "budgets_mb": {"wireless": 200, "wireline": 200},
            **changes,
        }
    )


def steps_of(recipe: RunRecipe, beside: Path = Path()) -> dict[str, str]:
    """Return each step's fingerprint."""
    found: dict[str, str] = {}
    for step in Graph(recipe, beside).steps:
        assert step.name not in found
        found[step.name] = step.fingerprint(found)
    return found


def settings_of(step: Step) -> Any:
    """Return the settings of a step."""
    return step.arguments["settings"]


@pytest.mark.parametrize("name", ["demo", "arms", "allocation", "distillation"])
def test_every_step_comes_after_what_it_needs(name: str) -> None:
    before: set[str] = set()
    for step in Graph(load_run_recipe(recipe_path(f"runs/{name}")), Path()).steps:
        assert set(step.needs) <= before, step.name
        before.add(step.name)


def test_an_arm_adds_what_it_does_differently_and_no_more() -> None:
    plain = steps_of(recipe_of())
    armed = steps_of(recipe_of(arms={"densest": {"placement": {"rule": "densest"}}}))
    assert set(armed) - set(plain) == {
        "grid-place-densest",
        "grid-edge-fl-objects-densest",
        "cloud-fl-objects-densest",
        "test-grid-edge-fl-objects-densest-grid",
        *(f"test-cloud-fl-objects-densest-{region}" for region in ("suburb", "grid", "arterial")),
    }
    assert {name for name in plain if plain[name] == armed[name]} >= {"plan", "pretrain-objects", "grid-place"}


def test_arms_of_which_only_stage_three_differs_share_stage_two() -> None:
    plain = steps_of(recipe_of())
    for own in ({"personal": ["head.*"]}, {"personal": {"pull": 0.1}}, {"cloud_strategy": "fedadam"}):
        armed = steps_of(recipe_of(arms={"own": {"federation": own}}))
        models = ("", "of-grid-") if "personal" in own else ("",)
        tests = {f"test-cloud-fl-objects-own-{m}{where}" for m in models for where in ("suburb", "grid", "arterial")}
        assert set(armed) - set(plain) == {"cloud-fl-objects-own", *tests}
        assert {name: armed[name] for name in plain} == plain


@pytest.mark.parametrize(("rounds", "trains"), [(0, False), (1, True)])
def test_stage_three_is_trained_and_tested_where_a_plan_has_rounds_of_it(rounds: int, trains: bool) -> None:
    plan = {"samples": 40, "edge_rounds": 1, "cloud_rounds": rounds}
    names = steps_of(recipe_of(tasks={"objects": {"plan": plan}}))
    assert any("cloud-fl" in name for name in names) == trains
    assert "test-grid-edge-fl-objects-grid" in names


def test_a_plan_within_a_horizon_reckons_with_the_network() -> None:
    def plan(**changes: Any) -> Any:
        return next(step for step in Graph(recipe_of(**changes), Path()).steps if step.name == "plan")

    on_air = plan(horizon_s=60.0, federation={"network": {"radio": {"bandwidth_mhz": 20}}})
    assert settings_of(on_air).air.drives == {"grid": "grid-registry-objects"}
    assert settings_of(on_air).air.network.radio.bandwidth_mhz == 20
    assert "grid-registry-objects" in on_air.needs
    for without in (plan(), plan(horizon_s=60.0), plan(federation={"network": {}})):
        assert settings_of(without).air is None
        assert "grid-registry-objects" not in without.needs


def test_further_edge_rounds_go_on_from_the_runs_own_edge_rounds() -> None:
    armed = Graph(recipe_of(arms={"further": {"stages": ["edge", "more_edge"]}}), Path())
    plain = {step.name for step in Graph(recipe_of(), Path()).steps}
    added = {step.name: step for step in armed.steps if step.name not in plain}
    more = "grid-more-edge-fl-objects"
    assert set(added) == {more, f"test-{more}-grid"}
    assert settings_of(added[more]).inputs.edge == "grid-edge-fl-objects"
    assert "grid-edge-fl-objects" in added[more].needs
    (edge,) = (step for step in armed.steps if step.name == "grid-edge-fl-objects")
    assert settings_of(edge).inputs.edge is None
    with pytest.raises(ValueError, match=r"must be \[edge\], \[edge, cloud\] or \[edge, more_edge\]"):
        recipe_of(arms={"further": {"stages": ["more_edge"]}})


def test_plans_are_made_anew_between_stages_from_what_the_run_itself_reached() -> None:
    arms = {"densest": {"placement": {"rule": "densest"}}, "equal": {"plan": "equal-stages"}}
    recipe = recipe_of(arms=arms, retrainings=1)
    steps = {step.name: step for step in Graph(recipe, Path()).steps}
    followed = {
        name: settings_of(step).plan if name.startswith("pretrain-") else settings_of(step).inputs.plan
        for name, step in steps.items()
        if name.startswith(("pretrain-", "grid-edge-fl"))
    } | {name: settings_of(step).first.plan for name, step in steps.items() if name.startswith("cloud-")}
    for name, plan in followed.items():
        after = "" if "pretrain" in name else "-after-edge" if "cloud" in name else "-after-pretrain"
        assert plan == ("plan-equal" if "equal" in name else f"plan{after}"), name
    assert len(followed) == 2 * (2 + 3 + 3)  # densest shares the pretraining of the run itself
    first, second = steps["plan-after-pretrain"], steps["plan-after-edge"]
    assert set(first.needs) == {"plan", "pretrain-objects", "rounds-pretrain-objects-grid"}
    ledgers = {"pretrain-objects", "grid-edge-fl-objects"}
    assert set(second.needs) == {"plan", "plan-after-pretrain", *ledgers, "rounds-grid-edge-fl-objects-grid"}
    assert all("-validation-" in settings_of(steps[f"rounds-{name}-grid"]).frames for name in ledgers)
    for fixed in (
        recipe_of(replan=False),
        recipe_of(tasks={"objects": {"plan": {"samples": 9, "edge_rounds": 1, "cloud_rounds": 1}}}),
    ):
        assert not [step.name for step in Graph(fixed, Path()).steps if step.name.startswith("plan-")]


def test_plans_are_updated_between_stages_or_not_at_all() -> None:
    assert [recipe_of(replan=old).replan for old in (True, False)] == ["stages", "none"]
    assert recipe_of().replan == "stages"
    with pytest.raises(ValueError, match="between stages, not between rounds"):
        recipe_of(replan="rounds")


def test_uploads_are_planned_where_the_recipe_asks_for_it_and_drawn_as_ever_otherwise() -> None:
    drawn, planned = steps_of(recipe_of(uploads="drawn")), steps_of(recipe_of(uploads="planned"))
    assert drawn == steps_of(recipe_of())
    assert drawn["plan"] != planned["plan"]
    (plan,) = (step for step in Graph(recipe_of(uploads="planned"), Path()).steps if step.name == "plan")
    assert settings_of(plan).uploads == UploadSettings(regions=("suburb",), network=None, range_m=40.0)


def test_a_retraining_repeats_what_learns_and_nothing_else() -> None:
    arms = {"densest": {"placement": {"rule": "densest"}, "stages": ["edge"]}}
    plain = Graph(recipe_of(arms=arms), Path())
    again = Graph(recipe_of(arms=arms, retrainings=2), Path())
    added = {step.name: step for step in again.steps if step.name not in {each.name for each in plain.steps}}
    trained = {"pretrain-objects", "grid-edge-fl-objects", "cloud-fl-objects", "grid-edge-fl-objects-densest"}
    assert {name for name in added if not name.startswith("test-")} == {
        f"{name.removesuffix('-densest')}-{arm}-again{n}"
        for name in trained
        for n in (1, 2)
        for arm in ("densest" if "densest" in name else "main",)
    }
    pretrained = {step.name: settings_of(step) for step in again.steps if step.run.__name__ == "pretrain_step"}
    seeds = {name: own.learning.seed for name, own in pretrained.items()}
    assert len(set(seeds.values())) == len(seeds) == 3
    uploads = {own.upload_seed for own in pretrained.values()}
    assert uploads == {1}
    ours = {step.name: step.arguments for step in plain.steps}
    assert all(step.arguments == ours[step.name] for step in again.steps if step.name in ours)


def test_retrainings_may_share_one_pretrained_network_and_its_tracks() -> None:
    graph = Graph(recipe_of(tasks=TRACKED, retrainings=2, retrain_from="edge"), Path())
    names = {step.name for step in graph.steps if "again2" in step.name and not step.name.startswith("test-")}
    assert names == {"grid-edge-fl-objects-main-again2", "cloud-fl-objects-main-again2"}
    by_name = {step.name: settings_of(step) for step in graph.steps}
    first, again = (by_name[f"grid-edge-fl-objects{end}"] for end in ("", "-main-again2"))
    assert first.inputs == again.inputs
    assert first.learning.seed != again.learning.seed


def test_an_arm_may_train_otherwise_on_the_same_frames() -> None:
    armed = Graph(recipe_of(arms={"slow": {"training": {"steps": 77}}}), Path())
    steps = {step.name: step for step in armed.steps}
    assert settings_of(steps["pretrain-objects-slow"]).learning.training.steps == 77
    assert "grid-place-slow" not in steps
    assert settings_of(steps["grid-edge-fl-objects-slow"]).inputs.place == "grid-place"
    with pytest.raises(ValueError, match=r"arms\.slow\.training: unknown field 'cooldowns'"):
        recipe_of(arms={"slow": {"training": {"cooldowns": [0.1]}}})


def test_another_draw_changes_the_test_scenes_alone() -> None:
    first, other = steps_of(recipe_of()), steps_of(recipe_of(test_draw=1))
    changed = {name for name in first if first[name] != other[name]}
    assert {name for name in changed if not name.startswith("test-")} == {
        *(f"{region}-test-objects" for region in ("suburb", "grid", "arterial")),
        "look",
    }


def test_what_decides_federations_alone_leaves_pretraining_shared() -> None:
    arms = {"mean": {"training": {"average_rounds": 5}}, "longer": {"training": {"steps": 99}}}
    names = Graph(recipe_of(arms=arms, retrainings=1), Path()).names
    assert names.pretrain("mean", "objects") == "pretrain-objects"
    assert names.pretrain("mean-again1", "objects") == "pretrain-objects-main-again1"
    assert names.edge("mean", "grid", "objects") == "grid-edge-fl-objects-mean"
    assert names.pretrain("longer", "objects") == "pretrain-objects-longer"


def test_another_plan_shares_recordings_that_no_plan_decides() -> None:
    armed = recipe_of(arms={"equal": {"plan": "equal-stages"}})
    names = Graph(armed, Path()).names
    assert names.pretrain("equal", "objects") == "pretrain-objects-equal"
    assert names.recording("grid", "test", "objects") == "grid-test-objects"
    (edge,) = (step for step in Graph(armed, Path()).steps if step.name == "grid-edge-objects")
    assert set(edge.needs) == {"grid-place", "grid-place-equal"}


def test_other_labels_of_one_task_leave_the_other_tasks_as_they_are() -> None:
    recipe = recipe_of(tasks=SEVERAL, arms={"own": {"labels": {"objects": "own-detections"}}})
    names = Graph(recipe, Path()).names
    assert names.edge("own", "grid", "objects") != names.edge(MAIN, "grid", "objects")
    assert names.edge("own", "grid", "signs") == names.edge(MAIN, "grid", "signs")


def test_no_task_trains_on_what_it_is_tested_on() -> None:
    for step in Graph(recipe_of(tasks=SEVERAL), Path()).steps:
        tested = [need for need in step.needs if "-test-" in need]
        assert not tested or step.name.startswith("test-") or step.name == "look"


def test_each_task_is_recorded_as_it_needs() -> None:
    fields = {
        step.name: settings_of(step).recipe
        for step in Graph(recipe_of(tasks=SEVERAL), Path()).steps
        if step.name.endswith(("-pool-objects", "-pool-signs", "-pool-trajectory"))
    }
    objects, signs, trajectory = (fields[f"suburb-pool-{task}"] for task in SEVERAL)
    assert not objects.vehicle_rig.cameras
    assert signs.vehicle_rig.cameras
    assert trajectory.every_s == 0.5
    assert trajectory.spins_per_scene * 0.5 > objects.spins_per_scene * 4.0 - 4.0
    assert objects.seed == signs.seed  # the same traffic


def test_recordings_of_an_own_town_name_its_files(tmp_path: Path) -> None:
    source = Path(recipe_path("grid")).parents[1] / "src/flcav/world/towns/grid"
    mine = tmp_path / "mine"
    mine.mkdir()
    for path in source.iterdir():
        (mine / path.name).write_bytes(path.read_bytes())
    regions = {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}, "own": {"town": "mine", "role": "unseen"}}
    before = steps_of(recipe_of(regions=regions), tmp_path)
    (mine / "town.yaml").write_text((mine / "town.yaml").read_text() + "\n# changed\n")
    after = steps_of(recipe_of(regions=regions), tmp_path)
    changed = {name for name in before if before[name] != after[name]}
    assert {"own-validation-objects", "own-test-objects"} <= changed
    assert {"suburb-pool-objects", "pretrain-objects"}.isdisjoint(changed)
    with pytest.raises(InputError, match="none of flcav, and there is no folder"):
        steps_of(recipe_of(regions=regions), tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"tasks": {"radar": {"history": "objects"}}}, "task 'radar'"),
        ({"tasks": {"objects": {"history": "objects", "labels": "future"}}}, "'future' is none of road"),
        ({"tasks": {"objects": {"history": "none.csv"}}}, "'none.csv' is no history of the package"),
        ({"tasks": {"signs": {"history": "objects"}}}, "has no rows of 'signs'"),
        (
            {"regions": {"a": {"role": "pretrain", "data": "none"}, "grid": {"role": "federate"}}},
            "regions: there is no dataset folder",
        ),
    ],
)
def test_what_cannot_be_found_is_said_before_anything_runs(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Graph(recipe_of(**changes), Path())


def test_arms_of_distillation_share_all_but_stage_two_and_have_their_labels_measured() -> None:
    arms = {
        "contrastive": {"labels": {"objects": "road-average"}, "distillation": {"terms": ["contrastive"]}},
        "average": {"labels": {"objects": "road-average"}, "stages": ["edge"]},
    }
    plain, armed = steps_of(recipe_of()), Graph(recipe_of(arms=arms), Path()).steps
    added = {step.name: settings_of(step) for step in armed if step.name not in plain}
    edges = {name: added[name] for name in added if name.startswith("grid-edge-fl")}
    assert list(edges) == ["grid-edge-fl-objects-contrastive", "grid-edge-fl-objects-average"]
    terms = [each.distillation.terms for each in edges.values()]
    assert terms == [("contrastive",), ("regression", "contrastive")]
    assert added["cloud-fl-objects-contrastive"].distillation.terms == ("contrastive",)
    assert {name.split("-")[0] for name in added} <= {"grid", "cloud", "test"}
    settings = {step.name: settings_of(step) for step in armed}
    scored = [name for name, own in settings.items() if getattr(own, "scored", False)]
    assert scored == ["grid-edge-fl-objects", *edges]
    assert settings["grid-edge-fl-objects"].distillation is None
    several = {step.name: settings_of(step) for step in Graph(recipe_of(tasks=SEVERAL, arms=arms), Path()).steps}
    assert [several[f"grid-edge-fl-{task}"].scored for task in SEVERAL] == [True, False, False]
    before = {step.name: settings_of(step) for step in Graph(recipe_of(), Path()).steps}
    assert not any(getattr(own, name, False) for own in before.values() for name in ("scored", "distillation"))
    changed = {
        "grid-edge-fl-objects",
        "plan",
        "grid-edge-objects",
    }  # labels are measured, messages priced, windows recorded
    assert {name for name, own in before.items() if settings[name] != own} == changed
    assert [own.labels is None for own in (before["plan"].tasks["objects"], settings["plan"].tasks["objects"])] == [
        True,
        False,
    ]
    with pytest.raises(ValueError, match=r"arms\.odd\.distillation: .*terms"):
        recipe_of(arms={"odd": {"distillation": {"terms": ["outputs"]}}})


def test_windows_of_the_road_average_are_recorded_where_vehicles_train_and_nowhere_else() -> None:
    def averaged(*windows: float) -> dict[str, Any]:
        """Return the settings of the steps of a run with an arm for each window."""
        about = {"labels": {"objects": "road-average"}, "stages": ["edge"]}
        arms = {f"arm{n}": {**about, "distillation": {"window_s": each}} for n, each in enumerate(windows)}
        return {step.name: settings_of(step) for step in Graph(recipe_of(arms=arms), Path()).steps}

    found = averaged(0.0, 0.5)
    recorded = {name: own.recipe.window_s for name, own in found.items() if hasattr(own, "recipe")}
    assert recorded.pop("grid-edge-objects") == 0.5
    assert set(recorded.values()) == {0.0}
    assert found["plan"].tasks["objects"].labels.distillation.window_s == 0.5  # the longer is priced
    assert averaged(0.0)["grid-edge-objects"].recipe.window_s == 0
    assert averaged()["grid-edge-objects"].recipe.window_s == 0
    with pytest.raises(InputError, match=r"distillation.window_s: arms have 0.3 s and 0.5 s; in a town all have one"):
        averaged(0.5, 0.3, 0.0)
    with pytest.raises(InputError, match=r"grid-edge-objects: field 'window_s' = 0.25: must be a multiple of 0.1 s"):
        averaged(0.25)


def test_messages_of_labels_are_priced_with_posts_where_any_arm_has_a_pose_graph() -> None:
    about = {"labels": {"objects": "road-average"}, "stages": ["edge"]}
    arms = {"plain": about, "graph": {**about, "distillation": {"pose_graph": True}}}
    for chosen, wanted in ((arms, True), ({"plain": about}, False)):
        steps = {step.name: settings_of(step) for step in Graph(recipe_of(arms=chosen), Path()).steps}
        assert steps["plan"].tasks["objects"].labels.distillation.pose_graph is wanted


def test_estimated_poses_are_logged_where_vehicles_train_and_change_the_steps_that_take_them() -> None:
    def asked(**changes: Any) -> dict[str, Any]:
        return {step.name: settings_of(step) for step in Graph(recipe_of(**changes), Path()).steps}

    drawn, found = asked(tasks=TRACKED), asked(tasks=TRACKED, navigation="estimated")
    recipes = {name: own.recipe for name, own in found.items() if hasattr(own, "recipe")}
    assert {name for name, own in recipes.items() if own.navigation_s} == {"grid-edge-objects"}
    rig = recipes["grid-edge-objects"].vehicle_rig
    assert (set(rig.gnss), set(rig.imus)) == ({"gnss"}, {"imu"})
    assert rig.lidars == drawn["grid-edge-objects"].recipe.vehicle_rig.lidars
    steps = [steps_of(recipe_of(tasks=TRACKED, **each)) for each in ({}, {"navigation": "estimated"})]
    changed = {name for name, fingerprint in steps[0].items() if steps[1][name] != fingerprint}
    assert changed >= {"grid-edge-objects", "grid-tracks-objects", "grid-edge-fl-objects"}
    assert changed.isdisjoint({"pretrain-objects", "suburb-pool-objects", "grid-registry-objects"})
    same = asked(navigation="estimated", tasks={"objects": {"history": "objects", "labels": "own-detections"}})
    assert not any(own.recipe.navigation_s for own in same.values() if hasattr(own, "recipe"))
    with pytest.raises(ValueError, match="navigation"):
        recipe_of(navigation="exact")
