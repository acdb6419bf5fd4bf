"""Arguments and words that several commands of `flcav release` share."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.terminal import echo
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from flcav.releases.candidate import Candidate
    from flcav.releases.repositories.repository import StagedTargets

CANDIDATE = typer.Argument(metavar="CANDIDATE", help="Folder of the candidate.")
DRIVING = typer.Option(..., "--driving", help="Weights of the network that drives (safetensors).")
NUMBER = typer.Option(..., "--release", min=1, max=10**9, help="Number of the release; it rises, roll-backs included.")
KEYS = typer.Option(..., "--key", help="Private key of the party (PEM); several of different owners may sign at once.")
REVOKE = typer.Option([], "--revoke", help="Vehicle that installs nothing any more; may be repeated.")
TASK = typer.Option("objects", "--task", help="Perception task of the network.")
AS_JSON = typer.Option(False, "--json", help="Print one JSON object.")


def describe_candidate(folder: Path) -> "Candidate":
    """Return the description of a candidate whose files are as it says."""
    from flcav.releases.candidate import check_files, read_candidate

    described = read_candidate(folder)
    check_files(folder, described)
    return described


def tell_signatures(repository: Path, state: "StagedTargets") -> None:
    """Print how many signatures a party's next metadata have."""
    more = "publish it" if state.complete else "another owner's is missing"
    echo(
        f"{repository}: {state.signatures} of {plural(state.threshold, 'signature')} of version {state.version}; {more}"
    )


def draw_page(folder: Path, repositories: list[Path]) -> None:
    """Draw the candidate's page with the signatures of the repositories' parties."""
    from flcav.releases.candidate import REPORT, read_candidate, write_candidate_page
    from flcav.releases.repositories.status import read_acknowledgements
    from flcav.releases.verification.verify import read_verification
    from flcav.report.pages.release_page import release_page
    from flcav.storage.files import sha256

    files = [path for path in sorted(folder.iterdir()) if path.is_file() and path.name != REPORT]
    hashes = {path.name: sha256(path) for path in files}
    signed = read_acknowledgements(folder, repositories)
    write_candidate_page(folder, release_page(read_candidate(folder), read_verification(folder), hashes, signed))
