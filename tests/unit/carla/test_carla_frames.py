"""CARLA's frame: conversions against the genuine client's own matrices, and there and back."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.carla.frames import MapFrame, from_mount, mirror, mirror_spin, to_rotation
from flcav.geometry import angles_of

MIRROR = np.diag((1.0, -1.0, 1.0, 1.0))
places = st.tuples(*[st.floats(-500, 500)] * 3)
turns = st.tuples(st.floats(-85, 85), st.floats(-179, 179), st.floats(-179, 179))


@given(places, turns, st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)))
def test_a_pose_comes_back(location, rotation, offset):
    frame = MapFrame(offset)
    back = frame.to_transform(frame.from_transform(location, rotation))
    assert np.allclose(back[0], location, atol=1e-6)
    assert np.allclose(back[1], rotation, atol=1e-6)


@settings(deadline=None)  # the first one loads the client
@given(places, turns)
def test_poses_are_those_of_the_genuine_client(location, rotation):
    carla = pytest.importorskip("carla", reason="needs the extra 'carla'")
    theirs = carla.Transform(carla.Location(*location), carla.Rotation(*rotation)).get_matrix()
    assert np.allclose(MIRROR @ MapFrame().from_transform(location, rotation) @ MIRROR, theirs, atol=1e-3)


def test_a_mount_to_the_right_is_at_negative_y():
    assert from_mount((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))[:3, 3].tolist() == [1.0, -2.0, 3.0]


def test_a_yaw_to_the_left_is_negative_and_a_raised_nose_is_a_positive_pitch():
    assert np.allclose(to_rotation(np.radians([90.0, -10.0, 5.0])), (10.0, -90.0, 5.0))


@given(st.floats(-20, 20))
def test_yaws_stay_within_180_degrees(yaw):
    turned = to_rotation(np.array((yaw, 0.0, 0.0)))[1]
    assert -180 <= turned < 180
    assert math.cos(math.radians(turned)) == pytest.approx(math.cos(yaw), abs=1e-9)


@given(turns)
def test_spins_mirror_as_axial_vectors(spin):
    """The mirrored spin turns mirrored vectors as the spin turns vectors."""
    arm = np.array((1.0, 2.0, 3.0))
    rate = np.radians(spin)
    assert np.allclose(mirror(np.cross(rate, arm)), np.cross(mirror_spin(rate), mirror(arm)))


def test_rotations_of_a_pose_are_read_back():
    pose = MapFrame().from_transform((0.0, 0.0, 0.0), (10.0, 20.0, 30.0))
    assert np.allclose(to_rotation(np.stack(angles_of(pose[:3, :3]))), (10.0, 20.0, 30.0))
