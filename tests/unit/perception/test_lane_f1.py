"""CULane's rule, against an independent one: lines as areas of shapely, all assignments tried."""

from itertools import permutations

import numpy as np
import pytest
import shapely

from flcav.perception.metrics.lane_lines import draw_line, f1_score, intersection_over_union, match_lines

SIZE = (640, 384)
FACTOR = 1640 / 640


def moved(line, columns):
    return line + np.array([columns, 0.0])


def area(line):
    points = (np.asarray(line) + 0.5) * FACTOR
    return shapely.LineString(points).buffer(15).intersection(shapely.box(0, 0, 1640, 984))


def overlap(one, other):
    a, b = area(one), area(other)
    return a.intersection(b).area / a.union(b).area


def count_hits(found, wanted):
    """Return the number of matches of the assignment of largest total IoU, counting only those above one half."""
    few, many = sorted((found, wanted), key=len)
    table = [[overlap(a, b) if overlap(a, b) > 0.5 else 0.0 for b in many] for a in few]
    totals = {
        order: sum(table[i][j] for i, j in enumerate(order)) for order in permutations(range(len(many)), len(few))
    }
    best = max(totals, key=lambda order: totals[order])
    return sum(table[i][j] > 0 for i, j in enumerate(best))


def draw_lines(rng, count):
    lines = []
    for _ in range(count):
        foot, top = rng.uniform(0, 640), rng.uniform(250, 390)
        v = np.linspace(383, 205, 12)
        lines.append(np.stack((top + (foot - top) * (v - 195) / 188 + rng.normal(0, 1.0, 12), v), axis=1))
    return lines


@pytest.mark.parametrize("seed", range(4))
def test_iou_and_matches_are_shapely_s(seed):
    rng = np.random.default_rng(seed)
    wanted = draw_lines(rng, 4)
    found = [moved(line, rng.normal(0, 4)) for line in wanted[:3]] + draw_lines(rng, 1)
    for one in found:
        for other in wanted:
            ours = intersection_over_union(draw_line(one, SIZE), draw_line(other, SIZE))
            assert ours == pytest.approx(overlap(one, other), abs=0.02)
    assert len(match_lines(found, wanted, SIZE)) == count_hits(found, wanted)


def test_a_line_matches_within_a_third_of_its_width():
    line = np.array([[320.0, 383.0], [320.0, 200.0]])
    width = 30 / FACTOR
    assert match_lines([moved(line, 0.30 * width)], [line], SIZE) == [(0, 0)]
    assert match_lines([moved(line, 0.37 * width)], [line], SIZE) == []


def test_two_found_lines_do_not_share_a_true_one():
    line = np.array([[320.0, 383.0], [320.0, 200.0]])
    assert match_lines([moved(line, 1), line], [line], SIZE) == [(1, 0)]
    assert match_lines([], [line], SIZE) == match_lines([line], [], SIZE) == []


def test_f1_is_the_harmonic_mean_and_unknown_without_lines():
    assert f1_score(np.array(6), np.array(8), np.array(12)) == pytest.approx(2 * (6 / 8) * (6 / 12) / (6 / 8 + 6 / 12))
    assert np.isnan(f1_score(np.array(0), np.array(3), np.array(0)))
