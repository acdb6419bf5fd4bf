"""The card as text: whatever it holds can be read in it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flcav.cli.main import run
from flcav.config import DamagedFile
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.perception.agents import choose_frames
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import Card, data_entry, read_card, save_network
from flcav.sensors.rig import RIGS

from .frames import frame

CLASSES = ["clear", "fog"]
METRICS = {
    "accuracy": 0.912345,
    "recall": {"clear": 0.5, "fog": None},
    "classes": CLASSES,
    "confusion": [[3, 1], [0, 4]],
    "slices": {"all": {"samples": 7, "error": 1.5}, "turning": None, "at junctions": {"samples": 2, "missed": 0.25}},
    "scores": [{"class": "Car", "ap": 0.75}, {"class": "Cyclist", "ap": None}],
}


def card(**fields: Any) -> Card:
    entry = {"name": "a/b", "frames": 8, "manifest": "f00d", "recipe": {"town": "grid", "poles": [], "every_s": 4.0}}
    base = {"task": "weather", "network": "tiny", "parameters": 9, "seed": 1, "samples": 8, "training": {"epochs": 2}}
    return Card.model_validate({**base, "data": (entry,), "metrics": METRICS, **fields})


def test_records_are_tables_and_numbers_are_lines():
    text = card().markdown()
    assert "- accuracy: 0.9123" in text
    assert "- recall: clear 0.5\n" in text
    assert "| | clear | fog |\n|---|---|---|\n| clear | 3 | 1 |\n| fog | 0 | 4 |" in text
    assert "| | samples | error | missed |\n|---|---|---|---|\n| all | 7 | 1.5 | none |" in text
    assert "| class | ap |\n|---|---|\n| Car | 0.75 |\n| Cyclist | none |" in text
    assert "- a/b: 8 frames; town grid, every_s 4; SHA-256 of its manifest f00d" in text
    assert text.startswith("# weather: tiny\n")
    assert not [odd for odd in ("{", "[", "\n\n\n") if odd in text]


def test_it_says_what_its_metrics_are_of():
    held = {
        "name": "c/held",
        "frames": 3,
        "manifest": "beef",
        "recipe": {"town": "ring", "weather": {"classes": CLASSES}},
    }
    validation = card(validation=held).markdown().partition("## Validation")[2]
    assert "- c/held: 3 frames; town ring, weather (classes (clear, fog))" in validation
    assert card(metrics={}).markdown().endswith("## Validation\n\n- none\n")


def test_a_damaged_card_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "weights.safetensors"
    save_network(WEATHER, WEATHER.build(next(iter(WEATHER.configurations.values()))), path, card())
    data = path.read_bytes()
    path.write_bytes(data.replace(b'\\"seed\\":1', b'\\"seed\\":?'))
    assert path.read_bytes() != data
    with pytest.raises(DamagedFile, match="weights with a damaged card"):
        read_card(path)
    with pytest.raises(SystemExit) as ended:
        run(["infer", "weather", "--weights", str(path), str(tmp_path)])
    assert ended.value.code == 2
    assert "weights with a damaged card" in capsys.readouterr().err


@dataclass(frozen=True)
class Once:
    """A source of one frame, of an agent with the given rig."""

    rig: dict[str, Any]

    def describe(self) -> dict[str, Any]:
        return {"town": "grid", "split": "train", "seed": 0, "warmup_s": 5.0, "vehicle_rig": self.rig, "frames": 1}

    def scenes(self) -> list[str]:
        return ["s0"]

    def frame_count(self, scene: str) -> int:
        return 1

    def frames(self, scene: str):
        yield frame([("veh0", "car", 9.0, 1.0, 12)])

    def trace(self, scene: str) -> None:
        return None


@pytest.mark.parametrize("known", [True, False])
def test_a_dataset_s_entry_names_its_rig_where_it_has_a_name(known, tmp_path):
    rig = RIGS["kitti_lidar"].model_dump(mode="json")
    record(Once(rig if known else {**rig, "cameras": {"front": {}}}), tmp_path / "run" / "data")
    data = Dataset.open(tmp_path / "run" / "data")
    entry = data_entry(data, choose_frames(WEATHER, None, data))
    assert entry.recipe.get("vehicle_rig") == ("kitti_lidar" if known else None)
    assert entry.recipe["warmup_s"] == 5.0
    assert (entry.name, entry.frames, entry.agents) == ("run/data", 1, ("cav0",))
