"""Records of a partition: the samples of a region's vehicles, and the distances of their labels to the region's."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from flcav.interface.wording import plural
from flcav.storage.records import LEFT_OUT, Record


@dataclass(frozen=True)
class VehicleHolding(Record):
    """The training data that a vehicle was dealt."""

    samples: int
    labels: Mapping[str, int]  # number of labels by class of the region; empty where the task has no classes
    distance: float | None  # total variation distance of its labels to the region's, in [0, 1]; None: no classes

    @property
    def listed(self) -> str:
        """The numbers of its labels as text."""
        return ", ".join(f"{count} {label}" for label, count in self.labels.items() if count)


@dataclass(frozen=True)
class Partitioned(Record):
    """The partition of a region's training samples."""

    by: str
    vehicles: Mapping[str, VehicleHolding]  # by client

    def describe(self) -> str:
        """Describe the partition in words."""
        holdings = [
            f"{name.rpartition('/')[2]} {plural(vehicle.samples, 'sample')}"
            + (f" ({vehicle.listed})" if vehicle.labels else "")
            for name, vehicle in self.vehicles.items()
        ]
        distances = [vehicle.distance for vehicle in self.vehicles.values() if vehicle.distance is not None]
        far = (
            f"; distance of their labels to the region's {min(distances):.2f} to {max(distances):.2f}"
            if distances
            else ""
        )
        return f"dealt by {self.by}: {', '.join(holdings)}{far}"


@dataclass(frozen=True)
class PartitionRow:
    """The field that a partition adds to the result of a stage."""

    partition: Annotated[Partitioned | None, LEFT_OUT] = None  # of stage II; None: vehicles have what they recorded
