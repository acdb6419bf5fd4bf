"""Settings of groups on request: `requests` of a recipe's federation."""

from pydantic import Field

from flcav.config import Config


class Requests(Config):
    """Groups on request instead of a fixed roster, in stage II: who asks, who is called, and when a group dissolves."""

    excess: float = Field(
        default=1.5, gt=0, le=1000
    )  # a vehicle asks whose loss on held-back frames is above so many times that at the end of pretraining
    held_back: float = Field(default=0.25, gt=0, lt=1)  # share of its labelled frames that a vehicle does not train on
    range_m: float = Field(default=300.0, gt=0, le=10_000)  # of V2X, between vehicles and from them to an edge server
    most: int | None = Field(
        default=None, ge=1, le=1000
    )  # members at most, with those that ask; a plan by a history chooses from 1 to that many; default: all
    overlap: float = Field(
        default=0.0, ge=0, lt=1
    )  # share of a further vehicle's data that those called before it have, in such a plan
    least_quality: float = Field(default=0.5, ge=0, le=1)  # of a member's data, relative to the best that are offered
    link_s: float = Field(default=10.0, gt=0)  # longest time of an update alone on the air, where there is a network
    roadside: bool = False  # whether units on poles in range join, with what they see and their own detector's labels
    patience: int = Field(default=2, ge=1, le=1000)  # rounds by which the loss on held-back frames has to fall
    least_gain: float = Field(default=0.01, ge=0, lt=1)  # share of the loss that these have to gain


class RequestFields(Config):
    """The fields of groups on request in the settings of federated learning."""

    requests: Requests | None = None  # stage II with groups on request; default: all vehicles of a region
