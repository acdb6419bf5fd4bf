"""The customer's directive on a release: which vehicles install it, as Uptane's director says it."""

import hashlib
from typing import Annotated, ClassVar

from pydantic import Field

from flcav.config import Config

WHOLE = 2**64
MILLION = 1_000_000
Name = Annotated[str, Field(min_length=1, max_length=200)]  # of a vehicle


class Directive(Config):
    """Instruction of the director repository on one release; it is signed as a part of its targets metadata."""

    document: ClassVar[str | None] = None

    release: int = Field(ge=1, le=10**9)
    share_ppm: int = Field(ge=0, le=MILLION)  # share of the fleet in millionths: canonical JSON has no fractions
    vehicles: tuple[Name, ...] = Field(default=(), max_length=100_000)  # that install it besides
    revoked: tuple[Name, ...] = Field(default=(), max_length=100_000)  # that install nothing

    @property
    def share(self) -> float:
        """Return the share of the fleet that installs it, drawn by the vehicles' names, in [0, 1]."""
        return self.share_ppm / MILLION


def place_in_queue(vehicle: str, task: str, release: int) -> float:
    """Return the place of a vehicle in the queue for a release, in [0, 1): uniform, and always the same."""
    digest = hashlib.sha256(f"{task}/{release}/{vehicle}".encode()).digest()
    return int.from_bytes(digest[:8], "big") / WHOLE


def is_assigned(vehicle: str, task: str, directive: Directive) -> bool:
    """Return whether a vehicle installs the release: by name, or by its place below the share; never a revoked one.

    A larger share includes the vehicles of a smaller one.
    """
    if vehicle in directive.revoked:
        return False
    return vehicle in directive.vehicles or place_in_queue(vehicle, task, directive.release) < directive.share
