"""FL requests that vehicles have sent to their fleet, as the requests of a group in a run.

Those that a group answers are kept in the folder of its step, so that a step which goes on after a stop has the same
group, and are marked in the registry, so that none is answered twice.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flcav.federation.messages.fl_request import FLRequest, parse_request
from flcav.runs.results.saved import Saved

if TYPE_CHECKING:
    from flcav.federation.runtimes.deployed import RegionalDeployment


@dataclass(frozen=True)
class TakenRequests(Saved):
    """FL requests for a task that were waiting when a group formed."""

    file: ClassVar[str] = "fl-requests.json"

    messages: Mapping[str, tuple[str, ...]]  # by client, as they were sent, the latest last

    def read(self) -> dict[str, FLRequest]:
        """Return the latest request of each client."""
        return {name: parse_request(own[-1].encode()) for name, own in self.messages.items()}


def take_requests(
    deployed: "RegionalDeployment | None", folder: Path, clients: Sequence[str], task: str
) -> TakenRequests:
    """Return the FL requests of a region's `clients` for a task: those that `folder` has, or that wait in the fleet."""
    if (folder / TakenRequests.file).exists():
        return TakenRequests.load(folder)
    if deployed is None or not clients:
        return TakenRequests({})
    waiting = deployed.fleet_of(clients[0]).list_requests(clients, task)
    taken = TakenRequests({name: tuple(content.decode() for content in own) for name, own in waiting.items()})
    taken.save(folder)
    return taken


def answer_requests(deployed: "RegionalDeployment | None", taken: TakenRequests, members: Sequence[str]) -> None:
    """Mark the requests of a group's members as answered."""
    answered = [each.encode() for name, own in taken.messages.items() if name in members for each in own]
    if deployed is not None and answered:
        deployed.fleet_of(members[0]).answer_requests(answered)
