"""The vehicle model against closed forms."""

import numpy as np
import pytest

from flcav.geometry import heading_vectors
from flcav.world.dynamics.vehicle import (
    AIR_KGPM3,
    GRAVITY_MPS2,
    GRIP_MPS2,
    ROLLING_MPS2,
    Pedals,
    PlanarMotion,
    Vehicles,
    drive_vehicles,
    make_blueprint,
    stack_blueprints,
)

SEDAN = make_blueprint("car", 3)
CARS = stack_blueprints([SEDAN])


def moving(speed: float, yaw: float = 0.0) -> PlanarMotion:
    return PlanarMotion(np.zeros((1, 2)), np.array([yaw]), speed * heading_vectors([yaw]), np.zeros(1), np.zeros(1))


def pedals(throttle=0.0, steer=0.0, brake=0.0, hand_brake=False, reverse=False) -> Pedals:
    return Pedals(
        np.array([throttle]), np.array([steer]), np.array([brake]), np.array([hand_brake]), np.array([reverse])
    )


def run(
    motion: PlanarMotion, steps: int, pressed: Pedals, pitch=0.0, dt_s=0.05, cars: Vehicles = CARS
) -> list[PlanarMotion]:
    out = [motion]
    for _ in range(steps):
        out.append(drive_vehicles(out[-1], cars, pressed, np.array([pitch]), dt_s))
    return out


@pytest.mark.parametrize("share", [0.1, 0.3, -0.5])
def test_a_steered_vehicle_drives_in_the_circle_of_the_bicycle_model(share: float):
    way = run(moving(3.0), 400, pedals(throttle=0.05, steer=share))[100:]
    at = np.array([each.position[0] for each in way])
    (x, y, rest), *_ = np.linalg.lstsq(np.c_[2 * at, np.ones(len(at))], (at**2).sum(axis=1))
    radius = np.sqrt(rest + x**2 + y**2)
    steer = share * SEDAN.steer_limit_rad
    middle = np.hypot(SEDAN.wheelbase_m / np.tan(steer), SEDAN.wheelbase_m / 2)
    assert radius == pytest.approx(middle, rel=2e-3)
    assert np.abs(np.hypot(at[:, 0] - x, at[:, 1] - y) - radius).max() < 0.01
    assert np.sign(way[-1].yaw_rate[0]) == np.sign(share)


@pytest.mark.parametrize("speed", [5.0, 20.0, 40.0])
@pytest.mark.parametrize("brake", [0.3, 1.0])
def test_the_braking_distance_is_that_of_brakes_and_drag(speed: float, brake: float):
    last = run(moving(speed), 1200, pedals(brake=brake))[-1]
    hold = min(brake * SEDAN.brake_mps2 + ROLLING_MPS2, GRIP_MPS2)
    drag = AIR_KGPM3 * SEDAN.drag_area_m2 / 2 / SEDAN.mass_kg
    assert last.position[0, 0] == pytest.approx(np.log1p(drag * speed**2 / hold) / (2 * drag), rel=0.01)
    assert not last.velocity.any()


def test_the_top_speed_balances_power_and_resistance():
    speed = np.linalg.norm(run(moving(30.0), 8000, pedals(throttle=1.0))[-1].velocity)
    drag = AIR_KGPM3 / 2 * SEDAN.drag_area_m2 * speed**2 + SEDAN.mass_kg * ROLLING_MPS2
    assert drag * speed == pytest.approx(SEDAN.power_w, rel=0.01)


def test_tyres_hold_no_more_than_their_grip():
    way = run(moving(25.0), 60, pedals(steer=1.0, brake=0.3))
    velocity = np.array([each.velocity[0] for each in way])
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() <= GRIP_MPS2 * 0.05 * (1 + 1e-9)


def test_a_vehicle_hit_from_the_side_slides_and_is_held_by_its_tyres_again():
    hit = moving(10.0)._replace(velocity=np.array([[10.0, 4.0]]), yaw_rate=np.array([3.0]))
    way = run(hit, 60, pedals())
    first = way[1].velocity[0] - hit.velocity[0]
    assert np.linalg.norm(first) == pytest.approx(GRIP_MPS2 * 0.05)
    last = way[-1]
    assert last.yaw_rate[0] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(last.velocity[0] / np.linalg.norm(last.velocity), heading_vectors(last.yaw[0]))


@pytest.mark.parametrize("pressed", [pedals(brake=0.5), pedals(hand_brake=True)])
def test_brakes_hold_a_vehicle_on_a_slope(pressed: Pedals):
    assert not run(moving(0.0), 40, pressed, pitch=0.15)[-1].position.any()


def test_a_vehicle_rolls_down_a_slope():
    last = run(moving(0.0), 20, pedals(), pitch=0.1)[-1]
    assert last.velocity[0, 0] == pytest.approx(GRAVITY_MPS2 * np.sin(0.1) - ROLLING_MPS2, rel=0.01)
    assert run(moving(0.0), 20, pedals(), pitch=-0.1)[-1].velocity[0, 0] == pytest.approx(-last.velocity[0, 0])


def test_reverse_is_backwards_and_slow():
    way = run(moving(0.0), 400, pedals(throttle=1.0, reverse=True, steer=0.05))
    assert -8.5 < way[-1].velocity[0] @ heading_vectors(way[-1].yaw[0]) < -7.0
    assert way[-1].yaw_rate[0] < 0


def test_shorter_steps_give_the_same_way():
    pressed = pedals(throttle=0.4, steer=0.04)
    coarse, fine = run(moving(8.0), 100, pressed)[-1], run(moving(8.0), 1000, pressed, dt_s=0.005)[-1]
    np.testing.assert_allclose(coarse.position, fine.position, atol=0.6)
    np.testing.assert_allclose(coarse.yaw, fine.yaw, atol=0.03)


def test_vehicles_in_one_call_do_not_affect_each_other():
    two = [SEDAN, make_blueprint("bus", 0)]
    both = PlanarMotion(*(np.repeat(array, 2, axis=0) for array in moving(7.0)))
    one = pedals(throttle=0.7, steer=0.2)
    pressed = one._replace(**{name: np.repeat(array, 2) for name, array in one._asdict().items()})
    together = drive_vehicles(both, stack_blueprints(two), pressed, np.zeros(2), 0.05)
    for row, each in enumerate(two):
        alone = drive_vehicles(
            moving(7.0), stack_blueprints([each]), pedals(throttle=0.7, steer=0.2), np.zeros(1), 0.05
        )
        for a, b in zip(together, alone):
            np.testing.assert_array_equal(a[row], b[0])
