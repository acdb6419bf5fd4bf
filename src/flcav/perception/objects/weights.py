"""Files of the detector's weights."""

from pathlib import Path

from flcav.perception import weights
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS


def save_network(network: Second, path: Path) -> None:
    """Write configuration and weights as safetensors, see `flcav.perception.weights`."""
    weights.save_network(OBJECTS, network, path)


def load_network(path: Path) -> Second:
    """Return the network saved at `path`, in evaluation mode; raises `InputError` for any other file."""
    return weights.load_network(OBJECTS, path)


def load_weights(network: Second, path: Path) -> None:
    """Load the weights at `path` into `network`; raises `InputError` where they are of another one."""
    weights.load_weights(OBJECTS, network, path)
