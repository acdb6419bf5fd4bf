"""What a training was asked for: all that decides its weights but the kind of processor and the libraries' versions."""

from pathlib import Path

from flcav.config import Config, InputError
from flcav.perception.card import Card, DataEntry
from flcav.perception.weights import read_card

TRAINED = ("device", "epochs", "patience", "batch", "learning_rate", "schedule")  # told in a card's training
Part = tuple[str, tuple[str, ...] | None]  # of data: a manifest's fingerprint, the agents; None where not recorded
NAMED = {"data": "other data or agents", "validation": "other validation data or agents"}


class Settings(Config):
    """Fields are None where an older card does not say."""

    task: str
    network: str
    seed: int
    threads: int | None
    device: str | None  # cpu | cuda
    data: tuple[Part, ...]
    validation: Part | None
    epochs: int
    patience: int | None  # None without validation data
    batch: int
    learning_rate: float
    schedule: str

    def differences(self, other: "Settings") -> str:
        """Return in words what is otherwise in `other`; "" where nothing is."""
        pairs = [(name, getattr(self, name), getattr(other, name)) for name in type(self).model_fields]
        return ", ".join(
            NAMED.get(name, f"{name} {theirs} instead of {own}") for name, own, theirs in pairs if own != theirs
        )


def settings_of(card: Card) -> Settings:
    """Return the settings of the training that a card is of."""
    return Settings.model_validate(
        {
            "task": card.task,
            "network": card.network,
            "seed": card.seed,
            "threads": card.threads,
            "data": tuple(map(part_of, card.data)),
            "validation": None if card.validation is None else part_of(card.validation),
            **{name: card.training.get(name) for name in TRAINED},
        }
    )


def part_of(entry: DataEntry) -> Part:
    """Return what a card's entry of a dataset says of which data they are."""
    return entry.manifest, entry.agents


def finished_card(path: Path, asked: Settings) -> Card | None:
    """Return the card of the weights at `path` if they are what is asked for; None where there are none.

    Raises `InputError` where they are others, so that nothing is lost.
    """
    if not path.exists():
        return None
    card = read_card(path)
    if different := asked.differences(settings_of(card)):
        raise InputError(f"{path}: weights of a training with other settings ({different}); choose another folder")
    return card
