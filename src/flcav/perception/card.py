"""What one should know of a network before using it: a model card, after Mitchell et al. (FAT* 2019)."""

from pathlib import Path
from typing import Any

from flcav import __version__
from flcav.config import Config
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.files import sha256, write_bytes

CARD_KEY = "flcav.card"  # metadata entry of a file of weights
LICENCE = "Apache-2.0"
RECIPE_FIELDS = ("town", "seed", "split", "scenes", "spins_per_scene", "every_s", "cavs", "poles", "weather")


class Card(Config):
    """How a file of weights came about; kept in its metadata as JSON and beside it as text."""

    task: str
    network: str  # name of the configuration
    parameters: int
    seed: int
    samples: int
    training: dict[str, Any]  # settings
    data: tuple[dict[str, Any], ...]  # one entry per dataset, see `data_entry`
    metrics: dict[str, Any]  # on the validation data; empty where there were none
    licence: str = LICENCE
    flcav: str = __version__

    def markdown(self) -> str:
        """Return the card as a page of text."""
        lines = [f"# {self.task}: {self.network}", ""]
        lines += [f"- {name}: {getattr(self, name)}" for name in ("parameters", "seed", "samples", "licence", "flcav")]
        for title, entries in (("Training", [self.training]), ("Data", self.data), ("Validation", [self.metrics])):
            rows = [f"- {key}: {value}" for entry in entries for key, value in entry.items()]
            lines += ["", f"## {title}", "", *(rows or ["- none"])]
        return "\n".join(lines) + "\n"


def data_entry(data: Dataset) -> dict[str, Any]:
    """Return what a dataset is: its name, its number of frames, its manifest's fingerprint, and its recipe.

    Of the recipe, what makes two datasets differ most: town, seed and weather; the manifest has the whole.
    """
    recipe = data.manifest.get("recipe", {})
    return {
        "name": data.folder.resolve().name,
        "frames": len(data),
        "manifest": sha256(data.folder / MANIFEST),
        "recipe": {name: recipe[name] for name in RECIPE_FIELDS if name in recipe},
    }


def write_card(card: Card, path: Path) -> None:
    """Write the card as Markdown, atomically."""
    write_bytes(path, card.markdown().encode())
