"""Saving and loading of SECOND's weights (safetensors)."""

from pathlib import Path

from flcav.perception import weights
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS


def save_network(network: Second, path: Path) -> None:
    """Save configuration and weights to `path` as safetensors, see `flcav.perception.weights`."""
    weights.save_network(OBJECTS, network, path)


def load_network(path: Path) -> Second:
    """Return the network saved at `path`, in evaluation mode; raises `InputError` for any other file."""
    return weights.load_network(OBJECTS, path)


def load_weights(network: Second, path: Path) -> None:
    """Load the weights at `path` into `network`; raises `InputError` where they are of another network."""
    weights.load_weights(OBJECTS, network, path)
