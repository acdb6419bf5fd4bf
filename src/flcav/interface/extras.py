"""Optional dependencies: the packages of flcav's extras and the command that installs them."""

import shlex
import sys
from importlib.metadata import requires


def format_install_command(extra: str) -> str:
    """Return the pip command that installs the packages of `extra`, as flcav's metadata list them, for this Python."""
    lines = (line.partition(";") for line in requires("flcav") or ())
    wanted = f"extra == '{extra}'"  # a build back end may write either quotes
    packages = [package.strip() for package, _, condition in lines if wanted in condition.replace('"', "'")]
    return shlex.join([sys.executable, "-m", "pip", "install", *packages])
