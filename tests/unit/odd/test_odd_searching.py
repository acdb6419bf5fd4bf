"""Search for failures: what is a candidate, what is distinct, what it learns, and what it keeps."""

import json
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch

from flcav.cli.main import run
from flcav.odd import searching
from flcav.odd.domain import Domain
from flcav.odd.sampling import SampledScenario, Space, sample_domain
from flcav.odd.scenery import Scenery
from flcav.odd.searching import (
    CandidateFrame,
    Failure,
    FailureModel,
    TriedFrame,
    choose_candidates,
    distinct,
    list_candidates,
    search_failures,
    take_apart,
)
from flcav.perception.objects.model import Second
from flcav.statistics.streams import stream
from flcav.world.trace import Event, Trace

NETWORK = cast(Second, torch.nn.Linear(1, 1))  # stands for a detector whose frames are not tested


@pytest.fixture(scope="module")
def space(urban: Domain, ring: Scenery) -> Space:
    return Space(urban, [ring])


@pytest.fixture(scope="module")
def sample(space: Space) -> SampledScenario:
    return sample_domain(space, 1, "sobol").samples[0]


def trace(places: dict[str, tuple[float, float]], category: dict[str, str], events: tuple[Event, ...] = ()) -> Trace:
    """Return two instants of actors that stand, all of which look along x."""
    count, still = len(places), np.zeros((2, len(places), 3))
    position = np.tile(np.pad(np.array([*places.values()], np.float64), ((0, 0), (0, 1))), (2, 1, 1))
    names = np.array([*places], np.str_)
    return Trace(
        town="ring",
        time_s=np.array([31.0, 33.0]),
        actor=names,
        category=np.array([category.get(name, "car") for name in places], np.str_),
        shape=np.zeros(count, np.int64),
        size=np.ones((count, 3)),
        present=np.ones((2, count), np.bool_),
        position=position,
        yaw=np.zeros((2, count)),
        velocity=still,
        acceleration=still,
        yaw_rate=np.zeros((2, count)),
        light=np.zeros(0, np.str_),
        light_state=np.zeros((2, 0), "<U1"),
        events=events,
    )


def test_a_candidate_has_the_nearest_in_its_path(sample: SampledScenario):
    places = {"cav0": (0.0, 0.0), "veh0": (25.0, 1.0), "ped0": (12.0, -1.0), "parked0": (5.0, 3.0), "veh1": (-9.0, 0.0)}
    first, second = list_candidates(sample, trace(places, {"ped0": "pedestrian"}), 1)
    assert first.cell[1] == "Pedestrian"
    assert first.cell[-2:] == ("agents 0", "distance 1")  # three that are not parked, 12 m ahead
    assert (first.spin, second.spin) == (0, 1)
    assert not first.plays
    (alone, _) = list_candidates(sample, trace({"cav0": (0.0, 0.0), "veh0": (41.0, 0.0), "bus0": (9.0, 0.0)},
                                               {"bus0": "bus"}), 1)  # fmt: skip
    assert alone.cell[1] == ""  # too far, and of no class of the detector


def test_frames_while_the_case_plays_come_first(sample: SampledScenario):
    places = {"cav0": (0.0, 0.0), "cav1": (0.0, 50.0)}
    found = list_candidates(sample, trace(places, {}, (Event("crash", 32.5, ("cav0",)),)), 2)
    chosen = choose_candidates(found, sample, FailureModel(), "sobol", stream(0, "test"))
    assert [each.spin for each in chosen] == [1, 1]  # at 33 s; each vehicle once, since it has not moved
    assert {each.vehicle for each in chosen} == {0, 1}


def test_frames_of_one_vehicle_are_apart():
    def at(vehicle: int, x: float) -> CandidateFrame:
        return CandidateFrame(0, vehicle, x, 0.0, ("none", "Car"), 0.0, False)

    taken = take_apart([at(0, 0.0), at(0, 4.0), at(1, 4.0), at(0, 6.0), at(0, 20.0)], 3)
    assert [(each.vehicle, each.x) for each in taken] == [(0, 0.0), (1, 4.0), (0, 6.0)]


def fails(sample: SampledScenario, each: CandidateFrame) -> tuple[Failure, ...]:
    """Return the failures that are planted: pedestrians and cyclists in the rain."""
    rainy = sample.weather.rain_mm_h >= 0.3 and each.cell[1] in ("Pedestrian", "Cyclist")
    return (Failure("frame", (*each.cell, "occlusion 0"), 9.0, 30),) if rainy else ()


class Plant:
    """A world without sensors, in which frames fail where it is planted."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.tested = 0
        monkeypatch.setattr(searching, "EmbeddedSource", lambda recipe: self)
        monkeypatch.setattr(searching, "list_candidates", self.candidates)
        monkeypatch.setattr(searching, "try_frames", self.try_frames)
        self.recipe = type("Recipe", (), {"cavs": 6})
        self.number = 0

    def scenes(self) -> list[str]:
        return ["scene"]

    def trace(self, scene: str) -> None:
        self.number += 1

    def candidates(self, sample: SampledScenario, trace: None, cavs: int) -> list[CandidateFrame]:
        rng, weather = np.random.default_rng(self.number), searching.weather_buckets(sample.weather)
        labels = rng.choice(["", "Car", "Pedestrian", "Cyclist"], 60, p=[0.5, 0.4, 0.05, 0.05]).tolist()
        rest = [(f"agents {rng.integers(4)}", f"distance {rng.integers(4)}") for _ in labels]
        return [
            CandidateFrame(spin, 0, 10.0 * spin, 0.0, (sample.place.kind, label, *weather, *more), float(spin), False)
            for spin, (label, more) in enumerate(zip(labels, rest))
        ]

    def try_frames(
        self, sample: SampledScenario, source: object, trace: None, chosen: list[CandidateFrame], network: None
    ):
        self.tested += len(chosen)
        return [TriedFrame(each.cell, fails(sample, each)) for each in chosen]


def search(space: Space, ring: Scenery, rule: str, seed: int = 3, scenarios: int = 40, kept: Path | None = None):
    return search_failures(space, NETWORK, scenarios, seed, rule, kept)


def test_a_search_finds_what_is_planted(space: Space, ring: Scenery, monkeypatch: pytest.MonkeyPatch):
    found = {}
    for rule in searching.RULES:
        plant = Plant(monkeypatch)
        found[rule] = len(distinct(search(space, ring, rule)))
        assert plant.tested == 40 * searching.FRAMES  # equal frames
    assert found["failures"] > 2 * found["path"] > 2 * found["sobol"]


def test_scenarios_that_are_kept_are_not_tested_again(
    space: Space, ring: Scenery, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    kept = tmp_path / "tested.jsonl"
    plant = Plant(monkeypatch)
    whole = search(space, ring, "failures", scenarios=6, kept=kept)
    lines = kept.read_text().splitlines()[1:]
    assert [json.loads(line)["key"] for line in lines] == list(dict.fromkeys(json.loads(line)["key"] for line in lines))
    kept.write_text("\n".join(lines[:4]) + "\n" + lines[4][:30])  # cut off
    plant = Plant(monkeypatch)
    plant.number = 4
    assert search(space, ring, "failures", scenarios=6, kept=kept) == whole
    assert plant.tested == 2 * searching.FRAMES
    plant = Plant(monkeypatch)
    assert search(space, ring, "failures", scenarios=6, kept=kept) == whole  # those after the line that was cut off
    assert plant.tested == 0


def test_a_cell_with_a_failure_promises_less(sample: SampledScenario):
    model, cell = FailureModel(), ("none", "Car", "rainfall 0", "visibility 2", "agents 1", "distance 1")
    other = (*cell[:-1], "distance 2")
    model.learn(sample, [TriedFrame(cell, (Failure("frame", (*cell, "occlusion 0"), 9.0, 30),))])
    assert model.promise((), cell, {}) < model.promise((), other, {}) == 1.0


def test_the_command_writes_recipes_with_their_failures(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        run(["odd", "sample", "urban", "--town", "ring", "--method", "failures", "--count", "1", "--out", str(out)])
    assert ended.value.code == 0
    assert "in 4 frames" in capsys.readouterr().out
    told = json.loads((out / "samples.json").read_text())["samples"]
    kept = [json.loads(line)["tested"] for line in (out / "tested.jsonl").read_text().splitlines() if line]
    assert told[0]["failures"] == [failure for frame in kept[0] for failure in frame["failures"]]
    assert (out / "1.yaml").exists()
