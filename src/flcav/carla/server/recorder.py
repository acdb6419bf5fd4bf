"""The recorder that clients start and stop: the traffic of an episode as a trace, a Parquet file of flcav."""

import logging
import re
from pathlib import Path

from flcav.world.snapshot import Snapshot, join_snapshots

FOLDER = Path("carla-recordings")  # in the working directory of the server
MOST_SNAPSHOTS = 12_000

log = logging.getLogger("flcav.carla")


class Recorder:
    """Collects the snapshots of one recording."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._snapshots: list[Snapshot] = []

    def start(self, name: str) -> str:
        """Begin a recording; return its file. Of the client's `name` only letters, digits, -, _ and . remain."""
        stem = re.sub(r"[^A-Za-z0-9_.-]", "_", name.replace("\\", "/").rpartition("/")[2]).strip(".")[:100]
        self._path = FOLDER / f"{stem or 'recording'}.parquet"
        self._snapshots = []
        return str(self._path.absolute())

    def add(self, snapshot: Snapshot) -> None:
        """Take the world after a tick, while a recording is under way; the first `MOST_SNAPSHOTS` of it."""
        if self._path is not None and len(self._snapshots) < MOST_SNAPSHOTS:
            self._snapshots.append(snapshot)

    def stop(self) -> None:
        """Write the recording, if there is one."""
        path, snapshots = self._path, self._snapshots
        self._path, self._snapshots = None, []
        if path is None or not snapshots:
            return
        FOLDER.mkdir(exist_ok=True)
        join_snapshots(snapshots).save(path)
        log.warning("recorded: %s", path)
