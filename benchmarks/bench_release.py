"""Releases in vehicles: the time of a check, and a fleet's update in which power fails in some vehicles.

Every vehicle updates in a process of its own, from a first release to a second one, whose weights have --kilobytes.
Power fails by SIGKILL at a random time of the update. Whatever was written by then stays, as a kernel would leave it;
what a disk loses that was not flushed is not simulated, but all files are flushed before they get their names.
"""

import argparse
import json
import os
import shutil
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from flcav.releases.candidate import CANDIDATE, CARD_KEY, WEIGHTS, Candidate, hash_card
from flcav.releases.checking import ReleaseRefused, RepositorySources, check_release, open_sources, trust_roots
from flcav.releases.installation import CURRENT, read_installed, update_vehicle
from flcav.releases.repositories.metadata import MILLION, Directive, read_root
from flcav.releases.repositories.repository import create_repository, publish, stage_release
from flcav.storage.files import sha256


def write_candidate(folder: Path, number: int, kilobytes: int) -> str:
    """Write a candidate of random weights; return their SHA-256."""
    folder.mkdir()
    values = np.random.default_rng(number).normal(size=kilobytes * 250).astype(np.float32)
    save_file({"weights": values}, folder / WEIGHTS, {CARD_KEY: json.dumps({"number": number})})
    weights = sha256(folder / WEIGHTS)
    described = Candidate(
        task="objects",
        release=number,
        changes="",
        audience="",
        network="none",
        weights=weights,
        driving="0" * 64,
        card=hash_card(folder / WEIGHTS),
        data=(),
    )
    (folder / CANDIDATE).write_text(described.model_dump_json())
    return weights


def release(parties: Path, candidate: Path, number: int) -> None:
    """Let both parties sign and publish a candidate."""
    for party, directive in (("image", None), ("director", Directive(release=number, share_ppm=MILLION))):
        keys = [parties / party / "keys" / f"{key}.pem" for key in (1, 2)]
        stage_release(parties / party, candidate, keys, directive)
        publish(parties / party)


def start_update(folder: Path, name: str, sources: RepositorySources) -> int:
    """Start the update of a vehicle in a process of its own, and return its number."""
    process = os.fork()
    if process:
        return process
    try:
        update_vehicle(folder, name, sources)
    except BaseException:
        os._exit(1)
    os._exit(0)


def main() -> None:
    """Measure the check, update the fleet, cut the power, and count what drives."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--vehicles", type=int, default=1000)
    arguments.add_argument("--kills", type=int, default=100)
    arguments.add_argument("--kilobytes", type=int, default=1300, help="size of the weights: 1300 are those of tiny")
    arguments.add_argument("--checks", type=int, default=50)
    asked = arguments.parse_args()
    out = Path(tempfile.mkdtemp(prefix="bench-release-"))
    try:
        create_repository(out / "image", "provider")
        create_repository(out / "director", "customer")
        signed = {
            write_candidate(out / "first", 1, asked.kilobytes),
            write_candidate(out / "second", 2, asked.kilobytes),
        }
        release(out, out / "first", 1)
        sources = open_sources(str(out / "image" / "repository"), str(out / "director" / "repository"))
        trust_roots(out / "car", read_root(out / "image"), read_root(out / "director"))
        update_vehicle(out / "car", "car", sources)
        shutil.copytree(out / "car", out / "fleet" / "0", symlinks=True)
        release(out, out / "second", 2)
        measure_checks(out / "car", sources, asked.checks)
        update_fleet(out, sources, asked.vehicles, asked.kills, signed)
    finally:
        shutil.rmtree(out)


def measure_checks(car: Path, sources: RepositorySources, times: int) -> None:
    """Print how long a vehicle checks a release that it has not installed: metadata of both parties, anew."""
    walls, cpus = [], []
    for _ in range(times):
        wall, cpu = time.perf_counter(), time.process_time()
        checked = check_release(car, "car", sources)
        assert checked.approved is not None
        walls.append(1000 * (time.perf_counter() - wall))
        cpus.append(1000 * (time.process_time() - cpu))
    most = np.quantile(walls, 0.95)
    print(f"check: median {np.median(walls):.1f} ms (CPU {np.median(cpus):.1f} ms), 95 % below {most:.1f} ms")


def update_fleet(out: Path, sources: RepositorySources, vehicles: int, kills: int, signed: set[str]) -> None:
    """Update the fleet, kill updates until `kills` were hit, restart these, and print what drives before and after."""
    rng = np.random.default_rng(0)
    first, began = out / "fleet" / "0", time.perf_counter()
    trials = [start_and_wait(out, first, sources, f"trial{number}", None)[2] for number in range(5)]
    counts: Counter[str] = Counter()
    for number in range(vehicles):
        victim = counts["killed"] < kills
        delay = float(rng.uniform(0, max(trials))) if victim else None
        folder, ended, _ = start_and_wait(out, first, sources, f"car{number}", delay)
        if ended == -signal.SIGKILL:
            counts["killed"] += 1
            counts["unsigned after a kill"] += not is_signed(folder, signed)
            counts[f"killed, drives release {json.loads((folder / CURRENT).read_text())['release']}"] += 1
            update_vehicle(folder, f"car{number}", sources)
        counts["unsigned in the end"] += not is_signed(folder, signed)
        installed = read_installed(folder)
        counts[f"in the end, drives release {installed.release if installed else 'none'}"] += 1
        shutil.rmtree(folder)
    print(f"{vehicles} vehicles, {(time.perf_counter() - began) / vehicles * 1000:.0f} ms each: {dict(counts)}")


def start_and_wait(
    out: Path, first: Path, sources: RepositorySources, name: str, kill_after_s: float | None
) -> tuple[Path, int, float]:
    """Return the folder of a vehicle that updated, or was killed, how its process ended, and after what time [s]."""
    folder = out / "fleet" / name
    shutil.copytree(first, folder, symlinks=True)
    began, process = time.perf_counter(), start_update(folder, name, sources)
    if kill_after_s is not None:
        time.sleep(kill_after_s)
        os.kill(process, signal.SIGKILL)  # of one that has ended, but was not waited for, it has no effect
    ended = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    return folder, ended, time.perf_counter() - began


def is_signed(folder: Path, signed: set[str]) -> bool:
    """Return whether the network that drives is one that both parties signed, by its own bytes."""
    try:
        installed = read_installed(folder)
    except ReleaseRefused:
        return False
    return installed is not None and installed.weights in signed


if __name__ == "__main__":
    main()
