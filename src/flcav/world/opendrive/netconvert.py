"""SUMO's netconvert, which reads and writes OpenDRIVE maps: a program of the extra `towns`."""

import importlib.util
import re
import subprocess
from pathlib import Path

from flcav.config import InputError
from flcav.interface.extras import format_install_command

NETCONVERT_S = 300.0  # longest run of netconvert


def run_netconvert(options: dict[str, str], folder: Path, origin: Path) -> None:
    """Run netconvert in `folder`; raises `InputError` where it is missing, or with its first error where it fails.

    Options name files by their names there: in a path it would take a comma for a separator.
    """
    found = importlib.util.find_spec("sumo")
    if found is None or not found.submodule_search_locations:
        raise InputError(
            f"OpenDRIVE maps need SUMO's netconvert, which is not installed: {format_install_command('towns')}"
        )
    binary = Path(next(iter(found.submodule_search_locations))) / "bin" / "netconvert"
    command = [str(binary), *(word for name, value in options.items() for word in (f"--{name}", value))]
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, errors="replace", check=False, timeout=NETCONVERT_S
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"{origin}: netconvert did not come to an end with this map in {NETCONVERT_S:.0f} s") from None
    if done.returncode:
        errors = re.findall(r"Error: (.*)", done.stderr) or [f"exit code {done.returncode}"]
        raise InputError(f"{origin}: netconvert cannot read this OpenDRIVE map ({errors[0].strip().rstrip('.')})")
