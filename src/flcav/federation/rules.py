"""Rules of a federation: who takes part in a round, what is sent, what is kept private, and how many are needed."""

from pydantic import Field

from flcav.config import Config
from flcav.federation.privacy import Privacy
from flcav.federation.selection import Selection
from flcav.federation.upload import Upload


class Rules(Config):
    """Rules of the rounds of a federation; by default every client sends its whole update in every round."""

    selection: Selection = Selection()  # of the clients of a round
    upload: Upload = Upload()  # form of the updates
    privacy: Privacy | None = None  # clipping and noise; default: none
    least_clients: int | None = Field(default=None, ge=1, le=10**6)  # whose updates a round needs; default: all chosen

    def of_servers(self) -> "Rules":
        """Return the rules among edge servers, which federate with the cloud, where vehicles have these.

        All take part, and send in the same form; noise is the vehicles', and all that comes after it is as private.
        """
        return Rules(upload=self.upload)
