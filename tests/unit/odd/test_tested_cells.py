"""The cells of a domain that a release is tested in, and what of the domain its test frames leave out."""

from flcav.dataset.store import Dataset
from flcav.odd.domain import Domain
from flcav.odd.measure import measure_domain, select_vehicles
from flcav.releases.verification.testing import VerificationFrame
from flcav.releases.verification.verify import find_cells


def test_frames_are_in_the_buckets_that_their_measurements_say(drive: Dataset, urban: Domain):
    frames = [VerificationFrame(drive.folder, number, "ring", "") for number in select_vehicles(drive)]
    cells, coverage = find_cells(frames, urban, ("junction", "visibility"))
    assert len(cells) == len(frames) == sum(coverage.frames.values())
    for cell, row in zip(cells, measure_domain(drive).rows(), strict=True):
        junction, _, bucket = cell.partition(" x ")
        low, high = (float(end) for end in bucket.strip("[])").split(","))
        assert junction == row["junction"]
        assert isinstance(row["visibility"], float)
        assert low <= row["visibility"] <= high
    left = {bucket for buckets in coverage.holes.values() for bucket in buckets}
    assert left
    assert not left & {part for cell in cells for part in cell.split(" x ")}
    assert 0 < coverage.grade < 1
