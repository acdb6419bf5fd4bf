"""Typed bodies of the requests of the planner's page: none names a path outside what was opened."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from flcav.planner.placing import Kinds, Question

MOST_BYTES = 16_000_000  # of a request

Name = Annotated[str, Field(max_length=200)]
Metres = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Range = Annotated[float, Field(ge=1, le=2000, allow_inf_nan=False)]
Price = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]


class Body(BaseModel):
    """A request's body: no field is passed over."""

    model_config = ConfigDict(extra="forbid")


class SensorOffer(Body):
    """A kind of sensor."""

    name: str = Field(max_length=60)
    range_m: Range
    cost: Price = 0.0


class AskedPlacement(Body):
    """A question about a workspace."""

    workspace: str = Field(max_length=64)
    kinds: list[SensorOffer] = Field(min_length=1, max_length=12)
    own: list[tuple[Metres, Metres]] = Field(default=[], max_length=100)
    line_of_sight: bool = True
    without: list[str] = Field(default=[], max_length=100)

    def question(self) -> Question:
        """Return it as `placing` takes it."""
        kinds = Kinds(
            tuple(each.name for each in self.kinds),
            tuple(each.range_m for each in self.kinds),
            tuple(each.cost for each in self.kinds),
        )
        return Question(kinds, tuple(self.own), self.line_of_sight, frozenset(self.without))


class AskedBest(AskedPlacement):
    """The best placement of a number of sensors, or within a budget."""

    count: int | None = Field(default=None, ge=1, le=10_000)
    budget: Price | None = None


class AskedNew(AskedPlacement):
    """A request for the places where a new pole sees most."""

    kind: int = Field(ge=0)
    uncovered: list[Annotated[int, Field(ge=0)]] = Field(max_length=1_000_000)


class AskedLook(Body):
    """A query for the area that a sensor sees from a pole, or from a place of one's own."""

    workspace: str = Field(max_length=64)
    pole: int | None = Field(default=None, ge=0)
    x: Metres = 0.0
    y: Metres = 0.0
    range_m: Range
    line_of_sight: bool = True


class AskedExport(AskedPlacement):
    """The files of a placement: pairs of a site, with own ones after the poles, and a kind."""

    pairs: list[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]] = Field(max_length=1000)


class AskedTown(Body):
    """A town of flcav to open."""

    town: str = Field(max_length=64)


class AskedPlan(Body):
    """A plan for budgets of one's own [MB, s]."""

    wireless_mb: Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
    wireline_mb: Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
    horizon_s: Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)] | None = None


class AskedFootage(Body):
    """A region or a task of the run, whose recordings are shown."""

    name: str = Field(default="", max_length=64)


class AskedError(Body):
    """An error of a workspace, by its row in the table."""

    workspace: str = Field(max_length=64)
    row: int = Field(ge=0)


class DroppedRun(Body):
    """The files of a run whose folder was dropped on the page, as base64 by path in the folder."""

    name: Name
    files: dict[Name, Annotated[str, Field(max_length=MOST_BYTES)]] = Field(max_length=100)
