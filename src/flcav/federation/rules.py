"""Rules of a federation: who takes part in a round, and how many have to."""

from pydantic import Field

from flcav.config import Config


class Rules(Config):
    """Rules of the rounds of a federation; by default every client takes part in every round."""

    least_clients: int | None = Field(default=None, ge=1, le=10**6)  # whose updates a round needs; default: all
