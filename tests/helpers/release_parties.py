from dataclasses import dataclass
from pathlib import Path

import torch

from flcav.perception.objects.config import pillars_config
from flcav.perception.objects.model import second
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import Card, DataEntry, load_network, read_card, save_network
from flcav.releases.checking import RepositorySources, open_sources
from flcav.releases.installation import Installed, update_vehicle
from flcav.releases.repositories.metadata import Directive
from flcav.releases.repositories.repository import publish, stage_release

ALL = 1_000_000


@dataclass(frozen=True)
class Parties:
    """A provider, a customer and a vehicle in one folder."""

    folder: Path

    @property
    def image(self) -> Path:
        return self.folder / "image"

    @property
    def director(self) -> Path:
        return self.folder / "director"

    @property
    def vehicle(self) -> Path:
        return self.folder / "vehicle"

    def candidate(self, number: int) -> Path:
        return self.folder / f"candidate{number}"

    def keys(self, party: str, *numbers: int) -> list[Path]:
        return [self.folder / party / "keys" / f"{number}.pem" for number in numbers]

    def release(self, party: str, number: int, directive: Directive | None = None) -> None:
        """Sign a candidate by two keys of a party and publish it; the customer's directive is the whole fleet."""
        if party == "director":
            directive = directive or Directive(release=number, share_ppm=ALL)
        stage_release(self.folder / party, self.candidate(number), self.keys(party, 1, 2), directive)
        publish(self.folder / party)

    def sources(self) -> RepositorySources:
        return open_sources(str(self.image / "repository"), str(self.director / "repository"))

    def update(self, sources: RepositorySources | None = None) -> Installed | None:
        return update_vehicle(self.vehicle, "cav0", sources or self.sources())


def write_weights(path: Path, seed: int) -> None:
    torch.manual_seed(seed)
    network = second(pillars_config())
    entry = DataEntry(
        name="train/data", frames=4, agents=("cav0",), manifest="ab" * 32, recipe={"town": "grid", "seed": 5}
    )
    card = Card(
        task="objects",
        network="pillars",
        parameters=sum(each.numel() for each in network.parameters()),
        seed=seed,
        samples=4,
        training={"steps": 1, "loss": 0.0, "scores": []},
        data=(entry,),
        metrics={},
    )
    save_network(OBJECTS, network, path, card)


def write_noisy(first: Path, path: Path) -> None:
    """Write the weights of a network that finds objects everywhere, made of `first`."""
    network = load_network(OBJECTS, first)
    with torch.no_grad():
        network.head.bias[: network.anchors_per_cell] += 9.0
    save_network(OBJECTS, network, path, read_card(first))
