"""Files of a reproduction: its numbers and pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flcav.cli.terminal import echo

if TYPE_CHECKING:
    from flcav.config import Json


def write_figures(out: Path, numbers: "Json", pictures: Mapping[str, bytes], sentences: Sequence[str]) -> None:
    """Write numbers and pictures, and say what was found."""
    from flcav.storage.files import write_bytes, write_json

    write_json(out / "result.json", numbers)
    for name, picture in pictures.items():
        write_bytes(out / name, picture)
    for sentence in sentences:
        echo(sentence)
