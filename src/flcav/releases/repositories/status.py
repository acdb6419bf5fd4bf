"""The status of a party's repository: releases, share of the fleet, pending signatures, and expiry."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from flcav.interface.wording import plural
from flcav.releases.candidate import Acknowledgement, find_acknowledgements
from flcav.releases.repositories.metadata import (
    list_releases,
    load_root,
    load_snapshot,
    load_targets,
    load_timestamp,
    read_directives,
    read_party,
    root_keys,
)
from flcav.releases.repositories.repository import StagedTargets, read_staged
from flcav.storage.records import LEFT_OUT, Record


@dataclass(frozen=True)
class RepositoryStatus(Record):
    """The status of a repository for one task."""

    party: str
    folder: str
    releases: tuple[int, ...]
    version: int  # of the targets metadata
    threshold: int
    keys: tuple[str, ...]
    fresh_until: datetime  # first expiry of its metadata, after which vehicles refuse it
    staged: Annotated[StagedTargets | None, LEFT_OUT] = None
    share: Annotated[float | None, LEFT_OUT] = None  # of the fleet; None for the provider
    revoked: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return the status in words."""
        named = ", ".join(map(str, self.releases)) or "none"
        lines = [f"{self.folder}: of the {self.party}, releases {named}, version {self.version}"]
        if self.share is not None:
            away = f", {plural(len(self.revoked), 'vehicle')} revoked" if self.revoked else ""
            lines.append(f"    {self.share:.0%} of the fleet{away}")
        if self.staged is not None:
            lines.append(
                f"    version {self.staged.version} has {self.staged.signatures} of "
                f"{plural(self.staged.threshold, 'signature')}"
            )
        late = self.fresh_until < datetime.now(UTC)
        lines.append(f"    {'expired' if late else 'fresh until'} {self.fresh_until:%Y-%m-%d %H:%M} UTC")
        return lines


def read_repository_status(out: Path, task: str) -> RepositoryStatus:
    """Return the status of a party's repository for a task; raises `InputError` where `out` is none."""
    party = read_party(out)
    targets = load_targets(out).signed
    root = load_root(out).signed
    directive = read_directives(targets.targets).get(task)
    return RepositoryStatus(
        party=party,
        folder=str(out),
        releases=tuple(list_releases(targets.targets, task)),
        version=targets.version,
        threshold=root.roles["targets"].threshold,
        keys=tuple(key.short for key in root_keys(root)),
        fresh_until=min(
            each.expires for each in (root, targets, load_snapshot(out).signed, load_timestamp(out).signed)
        ),
        staged=read_staged(out),
        share=None if directive is None else directive.share,
        revoked=() if directive is None else directive.revoked,
    )


def read_acknowledgements(folder: Path, repositories: list[Path]) -> list[Acknowledgement]:
    """Return the valid acknowledgements of the candidate in `folder` by the repositories' parties."""
    found = []
    for out in repositories:
        root = load_root(out).signed
        threshold = root.roles["targets"].threshold
        found.append(find_acknowledgements(folder, read_party(out), root_keys(root), threshold))
    return found
