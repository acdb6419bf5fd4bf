"""Experiments: their interface, studies of tasks, and the list of those that come with flcav.

They are folders of `reproductions/` in a checkout, and within the package of an installation (`flcav/reproductions`).
The name of a target is the path of its folder: `reproductions/federation/groups` is `federation-groups`.
"""

from pathlib import Path

import flcav

FOLDER = Path(flcav.__file__).parent / "reproductions"  # in a checkout, a link to the folder next to `src`


def list_experiments() -> dict[str, Path]:
    """Return the folders of the experiments that come with flcav, by name of the target."""
    folders = sorted(path.parent.relative_to(FOLDER) for path in FOLDER.rglob("run.py"))
    return {"-".join(folder.parts).replace("_", "-"): FOLDER / folder for folder in folders}
