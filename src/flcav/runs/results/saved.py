"""Results as JSON in the folders of their steps, and the names of the other files there."""

from pathlib import Path
from typing import ClassVar, Self

from flcav.config import read_json
from flcav.storage.files import write_json
from flcav.storage.records import Record

RESULT = "result.json"
PROBLEM = "problem.json"  # the allocation problem of a plan
WEIGHTS, LEDGER, ERRORS, OUTCOMES = "weights.safetensors", "ledger.parquet", "errors.parquet", "outcomes.npz"


class Saved(Record):
    """A record that is saved as JSON in a folder."""

    file: ClassVar[str] = RESULT  # default name of the file

    def save(self, folder: Path | str, name: str | None = None) -> None:
        """Write the record to `folder` atomically; tasks and regions keep their order."""
        write_json(Path(folder) / (name or self.file), self.as_json(), sort=False)

    @classmethod
    def load(cls, folder: Path | str, name: str | None = None) -> Self:
        """Load what `save` wrote; raises `InputError` if the file is missing or of another version."""
        path = Path(folder) / (name or cls.file)
        return cls.from_json(read_json(path), str(path))
