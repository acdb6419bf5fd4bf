"""docs/recipes.md: nothing is left out, everything is of today, and what it shows can be recorded."""

import re
from pathlib import Path

import pytest
import recipes_page
import yaml
from pydantic import BaseModel

from flcav.config import Config, _models_in, parse_config
from flcav.sensors.lidar.beams import BEAMS
from flcav.sensors.rig import RIGS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import CarlaRecipe, Recipe
from flcav.world.weather import WEATHERS

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "recipes.md").read_text()


def models(model: type[BaseModel], found: list[type[BaseModel]]) -> list[type[BaseModel]]:
    """Return `found` with the model, and those that stand within its fields."""
    if model not in found:
        found.append(model)
        for field in model.model_fields.values():
            for each in _models_in(field.annotation):
                models(each, found)
    return found


MODELS = models(CarlaRecipe, models(Recipe, []))


def test_the_page_is_of_today():
    assert recipes_page.page() == PAGE, "run python tools/recipes_page.py"


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_field_is_on_it_and_explained(model: type[Config]):
    said = recipes_page.comments(model)
    for name in model.model_fields:
        assert said[name], f"{model.__name__}.{name} has no comment"
        assert re.search(rf"^\| `{name}` \|.*\| [^|]+ \|$", PAGE, re.MULTILINE) or name == "settings", name


def test_names_that_recipes_know_are_on_it():
    for name in (*WEATHERS, *BEAMS, *RIGS):
        assert f"| `{name}` |" in PAGE
    assert "| `vlp16` | 16 | 15° to -15° | 1800 | 100 |" in PAGE
    assert "12 presets" in PAGE


def test_units_values_and_defaults_are_those_of_the_fields():
    for row in (
        "| `range_m` | number, 0.1 to 1000 [m] | `80` |",
        "| `rain_mm_h` | number, 0 to 300 [mm/h] | `0` | rain rate |",
        "| `force_noise` | number, 0 to 1000 [m/s^2 / sqrt(Hz)] |",
        "| `channels` | whole number, 1 to 256 | `32` | number of beams, one above the other |",
        "| `drops` | true, false | `true` |",
        "| `vehicle_rig` | [rig](#rigs) | `lidar32` |",
        "| `town` | text | **required** |",
    ):
        assert row in PAGE


def test_its_examples_are_recipes():
    example, weathers = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    recipe = parse_config(Recipe, yaml.safe_load(example), "the example")
    source = EmbeddedSource(recipe)
    frames = sum(source.frame_count(scene) for scene in source.scenes())
    assert f"2 scenes × 5 spins × 3 agents are {frames} frames" in PAGE
    forms = re.split(r"^(?=weather:)", weathers, flags=re.MULTILINE)[1:]
    assert len(forms) == 6
    for form in forms:
        parse_config(Recipe, {"town": "grid", **yaml.safe_load(form)}, "the page")


def test_its_links_lead_somewhere():
    headings = {heading.lower().replace(" ", "-") for heading in re.findall(r"^#+ (.*)$", PAGE, re.MULTILINE)}
    for target in re.findall(r"\]\(([^)]+)\)", PAGE):
        path, _, heading = target.partition("#")
        assert path or heading in headings, target
        assert not path or (ROOT / "docs" / path).exists(), target
        if path and heading:
            assert f"## {heading}".replace("-", " ") in (ROOT / "docs" / path).read_text().lower(), target
