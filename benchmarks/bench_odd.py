"""Judgement of a recording's frames by a domain, against reading them one by one; and 1,000 sampled recipes.

The reference reads pose, weather and annotations of each frame by `Dataset.frame`, and comes to the same verdicts.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from cpu_time import cpu_ms

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.odd.domain import Domain, read_domain
from flcav.odd.judge import judge_frames
from flcav.odd.measure import AROUND_M, Measurements, describe_weather, measure_domain, scenery_of
from flcav.odd.sampling import METHODS, Space, sample_domain, write_recipes
from flcav.odd.scenery import Scenery
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.map.town import TOWNS, load_town
from flcav.world.weather import Weather

LIDAR = {"channels": 2, "azimuth_steps": 32, "range_m": 100.0}
DRIVE = {
    "town": "ring",
    "scenes": 2,
    "warmup_s": 20.0,
    "spins_per_scene": 100,
    "every_s": 0.5,
    "cavs": 8,
    "vehicle_rig": {
        "lidars": {"lidar": {"mount": {"z": 1.8}, "settings": {"channels": 2, "azimuth_steps": 32, "range_m": 100.0}}}
    },
}
READ = 100  # frames that the reference reads
RECIPES = 1000


def judge_one_by_one(domain: Domain, data: Dataset, scenery: Scenery, frames: range) -> list[str]:
    """Return the verdict on each frame by the frame itself; speed and rig are taken as inside."""
    verdicts = []
    for i in frames:
        frame = data.frame(i)
        place, yaw = frame.world_from_agent[:2, 3], np.arctan2(*frame.world_from_agent[1::-1, 0])
        away = np.linalg.norm(frame.annotations.boxes.center[:, :2] - place, axis=1)
        moving = ~np.char.startswith(frame.annotations.track, "parked")
        assert frame.weather is not None
        sky = {name: np.array([getattr(frame.weather, name)]) for name in Weather.model_fields}
        columns = scenery.measure(place[None], np.array([yaw])) | describe_weather(sky)
        columns |= {"agents": np.array([((away <= AROUND_M) & moving).sum()]), "surface_type": np.array(["asphalt"])}
        columns |= {"ego_speed": np.zeros(1), "field_of_view": np.full(1, 360.0), "sensing_range": np.full(1, 100.0)}
        verdicts += judge_frames(domain, Measurements((i,), columns)).verdict.tolist()
    return verdicts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    urban = read_domain("urban")
    with tempfile.TemporaryDirectory() as scratch:
        record(EmbeddedSource(parse_config(Recipe, DRIVE, "recipe")), Path(scratch) / "data")
        data = Dataset.open(Path(scratch) / "data")
        scenery = scenery_of(data)
        every, part = tuple(range(len(data))), range(READ)

        assert scenery is not None
        verdicts = judge_frames(urban, measure_domain(data, every, scenery)).verdict.tolist()
        assert judge_one_by_one(urban, data, scenery, part) == verdicts[:READ]

        ours, reference = cpu_ms(
            [
                lambda: judge_frames(urban, measure_domain(data, every, scenery)),
                lambda: judge_one_by_one(urban, data, scenery, part),
            ],
            repeats,
        )
        begun = time.process_time()
        sceneries = [Scenery(load_town(name)) for name in TOWNS]
        towns_s = time.process_time() - begun
        sampled = {}
        for method in METHODS:
            begun = time.process_time()
            space = Space(urban, sceneries)
            drawn = sample_domain(space, RECIPES, method)
            write_recipes(drawn, space.sceneries, Path(scratch) / method, 0, lambda *_: None)
            sampled[method] = {"cpu_s": round(time.process_time() - begun, 2), "pairwise": round(drawn.pairwise, 3)}
    rate, slow = 1e3 * len(every) / ours, 1e3 * READ / reference
    result = {
        "frames": len(every),
        "frames_per_s": round(rate),
        "one_by_one_frames_per_s": round(slow),
        "ratio": round(rate / slow, 1),
        "towns_cpu_s": round(towns_s, 2),
        f"recipes_{RECIPES}": sampled,
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
