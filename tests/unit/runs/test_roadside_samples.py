"""Samples of roadside units that train: in place, of their own sweeps and detector, and wired to the edge server."""

import re

import numpy as np
import pytest

from flcav.config import InputError
from flcav.dataset.ground import DatasetGround
from flcav.geometry import points_in_boxes, pose, transform_points
from flcav.interface.progress import ignore_progress
from flcav.perception.objects.config import pillars_config
from flcav.perception.objects.truth import choose_lidar
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import resolve_settings
from flcav.runs.frames import Frames, record_frames
from flcav.runs.labels.pseudo_labels import road_views
from flcav.runs.labels.roadside import label_roadside
from flcav.runs.recipe import load_run_recipe
from flcav.sources.recipe import Recipe, recipe_path

CONFIG = pillars_config()


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    folder = tmp_path_factory.mktemp("units")
    drive = {"town": "suburb", "seed": 5, "scenes": 1, "spins_per_scene": 2, "cavs": 1, "warmup_s": 40.0, "poles": [3]}
    frames = record_frames(Recipe.model_validate(drive), folder, folder, ignore_progress)
    frames.save(folder)
    return Frames.open(folder)


def test_quarters_of_a_sweep_have_its_returns_and_boxes_in_place(split: Frames) -> None:
    spins = {(split.data.keys[i].scene, split.data.keys[i].index) for i in split.vehicles}
    views = road_views(split, [3], True, spins)
    (samples,) = label_roadside(split, [3], "suburb", CONFIG, spins).values()
    assert len(samples) == 4 * len(split.poles[3])
    found = 0
    for number, i in enumerate(split.poles[3]):
        frame, key = split.data.frame(i), split.data.keys[i]
        lidar = choose_lidar(frame)
        returns = transform_points(frame.world_from_sensor(lidar), frame.lidar[lidar][:, :3].astype(float))
        boxes = views[key.scene, key.index][3].boxes
        x, y = frame.agent_from_sensor[lidar][:2, 3].tolist()
        stands = frame.world_from_agent @ pose(x, y, -DatasetGround(split.data).height_of(i))
        for turn, sample in enumerate(samples[4 * number : 4 * number + 4]):
            world = stands @ pose(0, 0, -CONFIG.ground_z_m, turn * np.pi / 2)
            moved = transform_points(world, sample.points[:, :3].astype(float))
            nearest = [np.abs(returns - place).sum(axis=1).min() for place in moved[::97]]
            assert max(nearest) < 1e-3
            assert np.percentile(sample.points[:, 2], 20) == pytest.approx(CONFIG.ground_z_m, abs=0.3)
            for place in sample.boxes.transform(world).center:
                found += 1
                assert np.abs(boxes.center - place).sum(axis=1).min() < 1e-6
            assert (points_in_boxes(sample.points, sample.boxes, margin_m=0.1).sum(axis=1) > 0).all()
            assert sample.free is not None
    assert found > 0


def test_units_cannot_train_without_their_boxes() -> None:
    recipe = load_run_recipe(recipe_path("runs/radio_labels"))
    trains = recipe.federation.model_copy(update={"roadside_clients": True})
    settings = [*resolve_settings(recipe.model_copy(update={"federation": trains, "arms": {}})).values()]
    check_federations(recipe, settings)
    for labels, told in (("tracks+messages", "have no boxes"), ("road-average", "are made for vehicles alone")):
        bare = resolve_settings(
            recipe.model_copy(update={"federation": trains, "arms": {}}), {"objects": labels}
        ).values()
        with pytest.raises(InputError, match=f"roadside_clients: labels '{re.escape(labels)}' of 'objects' {told}"):
            check_federations(recipe, bare)
