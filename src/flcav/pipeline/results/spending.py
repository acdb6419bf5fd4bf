"""Record of the privacy that a vehicle spends in all trainings with its data."""

from dataclasses import dataclass
from typing import Annotated

from flcav.federation.privacy import SEEDED
from flcav.storage.records import LEFT_OUT, Record

TOGETHER = "a vehicle's whole data in all tasks and trainings together"


@dataclass(frozen=True)
class PrivacySpent(Record):
    """Epsilon and delta of differential privacy, of one client's whole data."""

    epsilon: float
    delta: float
    seeded: bool  # whether who knows the run's seed can draw the noise again
    noise: Annotated[tuple[float, ...] | None, LEFT_OUT] = None  # found for the planned rounds; None: it was given

    def describe(self) -> str:
        """Return it in words; of seeded noise with whom it does not hold against."""
        found = "" if self.noise is None else f", noise {' and '.join(f'{each:g}' for each in self.noise)} x clip"
        return f"epsilon {self.epsilon:.2f} at delta {self.delta:g}{found}" + (f" ({SEEDED})" if self.seeded else "")
