"""The Gymnasium environment, by Gymnasium's own checker."""

import sys
import warnings
from collections.abc import Iterator

import numpy as np
import pytest

from flcav.config import InputError
from flcav.sensors.lidar.lidar import Lidar

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium (the extra 'gym') is not installed")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from flcav.sources.environment import COLLISION, DrivingEnv  # noqa: E402


@pytest.fixture
def env() -> Iterator[DrivingEnv]:
    made = DrivingEnv("suburb", traffic=6)
    yield made
    made.close()


def follow(seen: dict[str, np.ndarray], speed: float) -> np.ndarray:
    """Return the action that follows the route at a speed [m/s]."""
    ahead, left = seen["route"][2]
    return np.array([speed - seen["ego"][0], np.arctan2(left, ahead) / np.radians(50)], np.float32).clip(-1, 1)


@pytest.mark.parametrize("lidar", [None, Lidar(channels=4, azimuth_steps=60)], ids=["without sensors", "LiDAR"])
def test_gymnasiums_checker_passes(lidar: Lidar | None):
    made = gymnasium.make("flcav.sources.environment:flcav/Driving-v0", town="suburb", traffic=4, lidar=lidar)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made.unwrapped)
    seen, _ = made.reset(seed=0)
    assert made.observation_space.contains(seen)
    assert ("lidar" in seen) == (lidar is not None)
    made.close()


def test_a_driver_who_follows_the_route_makes_progress(env: DrivingEnv):
    seen, _ = env.reset(seed=3)
    np.testing.assert_allclose(seen["route"][0], 0, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(np.diff(seen["route"], axis=0), axis=1).max(), 3.0, atol=1e-3)
    rewards, places = [], []
    for _ in range(60):
        seen, reward, ended, truncated, info = env.step(follow(seen, 5.0))
        rewards.append(reward)
        places.append(info["progress_m"])
        assert abs(seen["ego"][3]) < 1.0
        assert not truncated
        assert not ended
    assert 15 < sum(rewards) < 31
    np.testing.assert_allclose(np.diff(places), rewards[1:])
    others = np.linalg.norm(seen["actors"][:, :2], axis=1)
    assert (np.diff(others[others > 0]) >= 0).all()


def test_the_same_seed_and_actions_give_the_same_episode():
    def play(seed: int) -> list[bytes]:
        made = DrivingEnv("grid", traffic=10, lidar=Lidar(channels=4, azimuth_steps=60))
        random, (seen, _) = np.random.default_rng(0), made.reset(seed=seed)
        out = [b"".join(value.tobytes() for value in seen.values())]
        for _ in range(15):
            seen, reward, *_ = made.step(random.uniform(-1, 1, 2).astype(np.float32))
            out.append(b"".join(value.tobytes() for value in seen.values()) + str(reward).encode())
        made.close()
        return out

    first = play(5)
    assert play(5) == first
    assert play(6) != first


def test_leaving_the_road_ends_the_episode_with_or_without_a_collision(env: DrivingEnv):
    env.reset(seed=1)
    ended, seen, reward, info = False, {}, 0.0, {}
    while not ended:
        seen, reward, ended, _, info = env.step(np.array([1.0, 0.3], np.float32))
        assert info["time_s"] < 20
    assert bool(info["collisions"]) == (reward < -COLLISION / 2)
    assert info["ended"] == ("collision" if info["collisions"] else "off the route")
    assert info["collisions"] or abs(seen["ego"][3]) > 6.0


def test_the_end_of_an_episode_has_a_reason(env: DrivingEnv, monkeypatch: pytest.MonkeyPatch):
    seen, _ = env.reset(seed=3)
    *_, ended, _, info = env.step(follow(seen, 5.0))
    assert (ended, info["ended"]) == (False, None)
    for reason, changed, value in (
        ("off the route", "flcav.sources.environment.OFF_M", -1.0),
        ("arrived", "flcav.world.map.roads.Route.length_m", 0.0),
    ):
        seen, _ = env.reset(seed=3)
        with monkeypatch.context() as patch:
            patch.setattr(changed, value)
            *_, ended, _, info = env.step(follow(seen, 5.0))
        assert (ended, info["ended"]) == (True, reason)


def test_it_is_rendered_as_a_picture_that_follows_the_car():
    made = DrivingEnv("suburb", traffic=2, render_mode="rgb_array", dt_s=0.5)
    with pytest.raises(InputError, match="must be reset before it is rendered"):
        made.render()
    seen, _ = made.reset(seed=3)
    first = made.render()
    assert first is not None
    assert (first.dtype, first.shape) == (np.uint8, (320, 480, 3))
    assert made.metadata["render_fps"] == 2
    for _ in range(4):
        seen, *_ = made.step(follow(seen, 8.0))
    later = made.render()
    assert later is not None
    assert not np.array_equal(later, first)
    made.close()
    assert DrivingEnv("suburb", traffic=0).render() is None
    with pytest.raises(InputError, match="render_mode = 'human': must be rgb_array"):
        DrivingEnv("suburb", render_mode="human")


def test_a_step_before_the_reset_is_refused(env: DrivingEnv):
    with pytest.raises(InputError, match="must be reset before"):
        env.step(np.zeros(2, np.float32))


def test_without_gymnasium_one_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "flcav.sources.environment")
    with pytest.raises(InputError, match=r"needs gymnasium, which is in: .*pip install"):
        import flcav.sources.environment  # noqa: F401
