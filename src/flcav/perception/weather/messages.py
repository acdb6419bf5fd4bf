"""Labelled images as messages: the files as recorded, and the class of weather."""

from collections.abc import Callable, Sequence

from flcav.dataset.store import Dataset
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.images import pack_pictures, unpack_pictures
from flcav.perception.weather.samples import Sample, reduce_picture
from flcav.world.weather import Weather, classify_weather


def pack_frame(data: Dataset, number: int, named: Callable[[Weather], str | None] = classify_weather) -> bytes:
    """Return the message of a frame: its images, the class of its weather, and its scene."""
    weather = data.frame(number).weather
    label = None if weather is None else named(weather)
    return pack_arrays({"label": from_names([label or "", data.keys[number].scene]), **pack_pictures(data, number)})


def unpack_frame(message: bytes, classes: Sequence[str]) -> list[Sample]:
    """Return the samples in a message: those of `label_pictures`, none for a weather of no class."""
    arrays = unpack_arrays(message)
    label, scene = map(str, to_names(arrays["label"]))
    if label not in classes:
        return []
    return [Sample(reduce_picture(each), classes.index(label), scene) for each in unpack_pictures(arrays).values()]
