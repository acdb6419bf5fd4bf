"""Provenance of results: git revision, versions, kind of processor, threads and seed, but no times."""

import functools
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import flcav
from flcav.dataset.layout import PACKAGES, package_versions

LEARNING = ("flwr", "scipy", "torch")  # packages that affect results, besides those that affect recordings


@dataclass(frozen=True)
class Provenance:
    """Code, versions and processor that must be equal for equal results."""

    revision: str | None  # of git; None without a checkout
    uncommitted: bool  # whether the package's files have changed since that revision
    versions: Mapping[str, str]
    processor: str  # kind of processor, see `flcav.perception.device`
    threads: int
    seed: int | None


def provenance(seed: int | None = None) -> Provenance:
    """Return the provenance of results that this process computes on its CPU."""
    import torch  # here, so that steps without networks start without it

    from flcav.perception.device import CPU, processor_of

    revision, uncommitted = checkout(Path(flcav.__file__).parent)
    return Provenance(revision, uncommitted, versions(), processor_of(CPU), torch.get_num_threads(), seed)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages that affect results."""
    found = {"python": platform.python_version()}
    for name in sorted({*PACKAGES, *LEARNING}):
        try:
            found |= package_versions((name,))
        except PackageNotFoundError:
            continue  # embreex is not on every platform
    return found


@functools.cache
def checkout(folder: Path) -> tuple[str | None, bool]:
    """Return the revision of the git checkout that `folder` is tracked in, and whether files below it have changed.

    None where there is no git, no checkout, or one that ignores the folder, as it does an environment within it.
    """
    tracked = _git(folder, "ls-files", "--", ".")
    revision = _git(folder, "rev-parse", "HEAD") if tracked else None
    return revision, bool(revision and _git(folder, "status", "--porcelain", "--", "."))


def _git(folder: Path, *arguments: str) -> str | None:
    command = ["git", "--no-optional-locks", *arguments]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
