"""Files that are dropped on the planner's page: read from a temporary folder, which is removed."""

import base64
import binascii
import re
import tempfile
from pathlib import Path

from flcav.config import InputError, shorten
from flcav.planner.desk import Desk
from flcav.planner.requests import DroppedRun

OF_RUN = re.compile(r"results\.json|work/[A-Za-z0-9_][A-Za-z0-9_.-]{0,120}/errors\.parquet")  # files of a dropped run


def take_file(desk: Desk, workspace: str, name: str, content: bytes) -> str:
    """Put an uploaded file on the desk by the ending of its `name`; return the key of its workspace."""
    ending = Path(name).suffix.lower()
    if ending not in (".xodr", ".csv", ".parquet"):
        raise InputError("a map (.xodr) or a table of errors (.csv, .parquet) is wanted")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{_as_stem(Path(name).stem)}{ending}"
        path.write_bytes(content)
        try:
            return desk.open_map(path) if ending == ".xodr" else desk.add_errors(workspace, path)
        except InputError as error:
            raise InputError(str(error).replace(f"{folder}/", "")) from None


def take_run(desk: Desk, dropped: DroppedRun) -> None:
    """Put a dropped run on the desk: its rounds, and the errors of its regions; what it recorded is not uploaded."""
    from flcav.planner.replaying import open_run

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / _as_stem(dropped.name)
        for name, text in dropped.files.items():
            if not OF_RUN.fullmatch(name):
                raise InputError(f"{shorten(name)}: no file of a run that the planner reads")
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                path.write_bytes(base64.b64decode(text, validate=True))
            except binascii.Error:
                raise InputError(f"{shorten(name)}: is not in base64") from None
        try:
            found = open_run(root)
        except InputError as error:
            raise InputError(str(error).replace(f"{folder}/", "")) from None
    desk.run, desk.footage, desk.first = found.run, None, desk.first or found.first
    for key, space in found.spaces.items():
        desk.add(space, key)


def _as_stem(name: str) -> str:
    return "".join(sign if sign.isalnum() or sign in "-_" else "_" for sign in name)[:60] or "file"
