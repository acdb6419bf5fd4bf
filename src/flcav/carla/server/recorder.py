"""The recorder that clients start and stop: it writes an episode's traffic as a trace, in a Parquet file."""

import logging
import re
from pathlib import Path

from flcav.world.snapshot import Snapshot, join_snapshots

FOLDER = Path("carla-recordings")  # in the working directory of the server
MOST_SNAPSHOTS = 12_000

log = logging.getLogger("flcav.carla")


class Recorder:
    """A recorder of the world's snapshots."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._snapshots: list[Snapshot] = []

    def start(self, name: str) -> str:
        """Start a recording; return its path. Only letters, digits, -, _ and . of the client's `name` are kept."""
        stem = re.sub(r"[^A-Za-z0-9_.-]", "_", name.replace("\\", "/").rpartition("/")[2]).strip(".")[:100]
        self._path = FOLDER / f"{stem or 'recording'}.parquet"
        self._snapshots = []
        return str(self._path.absolute())

    def add(self, snapshot: Snapshot) -> None:
        """Record the world after a tick, up to `MOST_SNAPSHOTS`; without a recording, do nothing."""
        if self._path is not None and len(self._snapshots) < MOST_SNAPSHOTS:
            self._snapshots.append(snapshot)

    def stop(self) -> None:
        """Write the recording, if there is one."""
        path = self._path
        snapshots = self._snapshots
        self._path, self._snapshots = None, []
        if path is None or not snapshots:
            return
        FOLDER.mkdir(exist_ok=True)
        join_snapshots(snapshots).save(path)
        log.warning("recorded: %s", path)
