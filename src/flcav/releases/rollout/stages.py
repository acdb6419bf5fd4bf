"""Stages of a roll-out: canaries first, then larger shares, while shadow runs agree; and roll-backs.

A roll-back is a release of its own: earlier weights under a number that rises, so that no vehicle ever takes an older
number, whoever signs it.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

from flcav.config import InputError, parse_config
from flcav.releases.candidates.candidate import (
    ACKNOWLEDGEMENTS,
    CANDIDATE,
    REPORT,
    Candidate,
    check_files,
    read_candidate,
)
from flcav.releases.repositories.directive import MILLION, Directive
from flcav.releases.repositories.metadata import load_targets, read_directives
from flcav.releases.repositories.repository import Staged, stage_directive
from flcav.releases.rollout.shadow import ShadowDecision
from flcav.storage.files import write_json

STAGES = (0.01, 0.05, 0.2, 1.0)  # shares of the fleet


def read_directive(out: Path, task: str) -> Directive:
    """Return the customer's directive on a task; raises `InputError` where there is none."""
    found = read_directives(load_targets(out).signed.targets).get(task)
    if found is None:
        raise InputError(f"{out}: has no directive on {task}, so is not the customer's repository, or names no release")
    return found


def next_share(share: float, decision: ShadowDecision) -> float:
    """Return the share of the fleet that follows: the next of `STAGES`, the same where the canaries wait, or 0.

    0 stops the roll-out: vehicles that have the release keep it until a roll-back.
    """
    if decision.judgement == "stop":
        return 0.0
    if decision.judgement == "wait":
        return share
    return next((stage for stage in STAGES if stage > share), 1.0)


def change_share(
    out: Path, task: str, share: float, keys: Sequence[Path], revoke: Sequence[str] = ()
) -> tuple[Directive, Staged]:
    """Stage a directive with another share of the fleet, and more revoked vehicles; return it and its signatures.

    A share of 0 stops the roll-out for vehicles that were named, too.
    """
    now = read_directive(out, task)
    revoked, named = tuple(sorted({*now.revoked, *revoke})), now.vehicles if share else ()
    updates = {"share_ppm": round(share * MILLION), "revoked": revoked, "vehicles": named}
    changed = parse_config(Directive, now.model_dump() | updates, "the directive")
    return changed, stage_directive(out, task, changed, keys)


def roll_back(earlier: Path, release: int, reason: str, out: Path, driving: str) -> Candidate:
    """Write the candidate of a roll-back to `out`: the weights of an earlier one under a number that rises.

    Its verification is that of the earlier candidate; acknowledgements are given anew.

    Args:
        earlier: folder of the candidate that is to drive again.
        release: number of the roll-back, above all that were released.
        reason: why, in words.
        out: the new folder.
        driving: SHA-256 of the weights that it replaces.

    Raises:
        InputError: for a folder that exists, a damaged candidate, and a number that does not rise.
    """
    candidate = read_candidate(earlier)
    check_files(earlier, candidate)
    if release <= candidate.release:
        raise InputError(f"release {release}: a roll-back has a number above {candidate.release}, and all others")
    if out.exists():
        raise InputError(f"{out}: exists already; a candidate is a new folder")
    changes = f"Roll-back to release {candidate.release}. {reason}"
    updates = {"release": release, "changes": changes, "driving": driving, "rolls_back": candidate.release}
    changed = parse_config(Candidate, candidate.model_dump() | updates, f"release {release}")
    shutil.copytree(earlier, out, ignore=shutil.ignore_patterns(ACKNOWLEDGEMENTS, REPORT))
    write_json(out / CANDIDATE, changed.model_dump(mode="json"), sort=False)
    return changed
