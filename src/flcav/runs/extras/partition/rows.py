"""Records of a partition: what each vehicle of a region holds, and how far its labels are from the region's."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from flcav.interface.wording import plural
from flcav.storage.records import LEFT_OUT, Record


@dataclass(frozen=True)
class VehicleHolding(Record):
    """The training data that a vehicle was dealt."""

    samples: int
    labels: Mapping[str, int]  # their number by class of the region; empty where the task has no classes
    distance: float | None  # total variation distance of its labels to the region's; None: the task has no classes

    @property
    def listed(self) -> str:
        """Return the labels that it has, in words."""
        return ", ".join(f"{count} {label}" for label, count in self.labels.items() if count)


@dataclass(frozen=True)
class Partitioned(Record):
    """The partition of a region's training samples."""

    by: str
    vehicles: Mapping[str, VehicleHolding]  # by client

    def describe(self) -> str:
        """Return the partition in words."""
        told = [
            f"{name.rpartition('/')[2]} {plural(own.samples, 'sample')}" + (f" ({own.listed})" if own.labels else "")
            for name, own in self.vehicles.items()
        ]
        distances = [own.distance for own in self.vehicles.values() if own.distance is not None]
        far = (
            f"; distance of their labels to the region's {min(distances):.2f} to {max(distances):.2f}"
            if distances
            else ""
        )
        return f"dealt by {self.by}: {', '.join(told)}{far}"


@dataclass(frozen=True)
class PartitionRow:
    """What a partition adds to the result of a stage."""

    partition: Annotated[Partitioned | None, LEFT_OUT] = None  # of stage II; None: vehicles have what they recorded
