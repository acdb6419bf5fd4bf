"""What flcav works without: the packages of its extras, and how to get them."""

import shlex
import sys
from importlib.metadata import requires


def installation(extra: str) -> str:
    """Return the command that installs an extra's packages for this Python, wherever flcav itself came from."""
    lines = (line.partition(";") for line in requires("flcav") or ())
    wanted = f"extra == '{extra}'"  # a build back end may write either quotes
    packages = [package.strip() for package, _, condition in lines if wanted in condition.replace('"', "'")]
    return shlex.join([sys.executable, "-m", "pip", "install", *packages])
