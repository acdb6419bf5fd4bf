"""A vehicle whose node's clock is ahead by the seconds in a file, at each look: run_late_vehicle.py FOLDER FILE."""

import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

from flwr.supercore import date

folder, ahead = map(Path, sys.argv[1:])
date.now = lambda: datetime.now(UTC) + timedelta(seconds=float(ahead.read_text()))  # before others import it

if __name__ == "__main__":
    from flcav.federation.links.vehicle_app import preload_assignment
    from flcav.fleet.up import run_vehicle_processes

    run_vehicle_processes(folder, preload_assignment)
