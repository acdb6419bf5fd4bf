"""A whole recording against bare Embree tracing of its LiDAR rays, in one run and one thread.

Five vehicles and nine roadside suites with LiDARs of 64 x 1024 rays record spins of the town `grid`: sensing, labels,
encoding and writing, with and without a 640 x 384 camera on each vehicle. The reference traces the same LiDAR rays
once, to their first surface. Besides: how the cost grows with rays and with actors, memory with frames, and what the
encodings of an image weigh and cost.
"""

import argparse
import io
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from cpu_time import cpu_ms
from numpy.typing import NDArray
from PIL import Image

from flcav.dataset.payloads import encode_plane
from flcav.dataset.recording.jobs import ScenePart, SceneTraffic, perform_job
from flcav.dataset.recording.recorder import record
from flcav.geometry import pose
from flcav.sensors.lidar.lidar import build_ray_pattern
from flcav.sensors.observe import observe
from flcav.sensors.rig import Rig
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.scene import Scene
from flcav.world.trace import Trace

LIDAR = {"channels": 64, "azimuth_steps": 1024, "range_m": 100.0}
CAMERA = {"front": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 640, "height": 384}}}
SPINS = 2


def recipe(cameras: bool = False, spins: int = SPINS, scenes: int = 1) -> Recipe:
    """Return the recipe of five vehicles and nine roadside suites."""
    return Recipe.model_validate(
        {
            "town": "grid",
            "seed": 7,
            "cavs": 5,
            "poles": "all",
            "scenes": scenes,
            "spins_per_scene": spins,
            "vehicle_rig": {
                "lidars": {"lidar": {"mount": {"z": 1.85}, "settings": LIDAR}},
                "cameras": CAMERA if cameras else {},
            },
            "pole_rig": {"lidars": {"lidar": {"settings": {**LIDAR, "down_deg": -45.0}}}},
        }
    )


def whole_recording(repeats: int) -> dict[str, float]:
    """Return CPU-ms per spin of 14 agents, and their ratios to the bare trace."""
    with tempfile.TemporaryDirectory() as folder:
        plain, seeing = (EmbeddedSource(recipe(cameras)) for cameras in (False, True))
        name, works = plain.scenes()[0], []
        for source, work in ((plain, Path(folder) / "plain"), (seeing, Path(folder) / "seeing")):
            perform_job(source, SceneTraffic(name), work, _no_report)
            parts = iter([ScenePart(name, number, source.frame_count(name)) for number in range(repeats + 1)])
            works.append(
                lambda source=source, work=work, parts=parts: perform_job(source, next(parts), work, _no_report)
            )
        trace = plain.trace(name)
        scene = Scene(plain.town, trace)
        bare, lidar, cameras = cpu_ms((lambda: _bare(scene, plain), *works), repeats)
    bare, lidar, cameras = (value / SPINS for value in (bare, lidar, cameras))
    return {
        "bare_ms": bare,
        "lidar_ms": lidar,
        "lidar_over_bare": lidar / bare,
        "cameras_ms": cameras,
        "cameras_over_bare": cameras / bare,
        "lidar_spins_per_cpu_s": 1e3 / lidar,
        "cameras_spins_per_cpu_s": 1e3 / cameras,
    }


def _no_report() -> None:
    """Count no frames."""


def _bare(scene: Scene, source: EmbeddedSource) -> None:
    """Trace every LiDAR ray of the recording once."""
    for index in range(SPINS):
        scene.move_to(index)
        for agent in source.agents:
            own = np.flatnonzero(scene.trace.actor == agent)
            hidden = int(own[0]) if len(own) else None
            rig = source.recipe.pole_rig if hidden is None else source.recipe.vehicle_rig
            lidar = rig.lidars["lidar"]
            at = _agent(scene, agent, hidden) @ lidar.mount.agent_from_sensor()
            scene.cast(at, build_ray_pattern(lidar.settings), far_m=lidar.settings.range_m, hidden=hidden)


def _agent(scene: Scene, agent: str, actor: int | None) -> NDArray[np.float64]:
    if actor is not None:
        return scene.world_from_actor(actor)
    poles = scene.town.poles
    row = int(np.flatnonzero(poles.id == int(agent.removeprefix("pole")))[0])
    x, y, z = poles.position[row]
    return pose(x, y, z, float(poles.yaw[row]))


def two_cores(cameras: bool, spins: int = 16) -> float:
    """Return spins of the 14 agents per second of two processes, from the first third of a recording on."""
    seen: list[tuple[float, int]] = []
    with tempfile.TemporaryDirectory() as folder:
        source = EmbeddedSource(recipe(cameras, spins))
        record(
            source, Path(folder) / "data", jobs=2, progress=lambda done, *_: seen.append((time.perf_counter(), done))
        )
    started = next(row for row in seen if row[1] >= seen[-1][1] / 3)
    ended = next(row for row in seen if row[1] == seen[-1][1])
    return (ended[1] - started[1]) / (ended[0] - started[0]) / len(source.agents)


def growth_with_rays(repeats: int) -> dict[int, float]:
    """Return CPU-us per ray of a sweep, labelled, by the number of its rays."""
    source = EmbeddedSource(recipe())
    scene = Scene(source.town, source.trace(source.scenes()[0]))
    rigs = {
        channels: Rig.model_validate(
            {"lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {**LIDAR, "channels": channels}}}}
        )
        for channels in (16, 32, 64, 128)
    }
    works = [lambda rig=rig: observe(scene, rig, "cav0", 0, scene_name="s", seed=0) for rig in rigs.values()]
    return {channels * 1024: 1e3 * taken / (channels * 1024) for channels, taken in zip(rigs, cpu_ms(works, repeats))}


def growth_with_actors(repeats: int) -> dict[int, float]:
    """Return CPU-ms of a labelled sweep of 64 x 1024 rays by the number of actors in town."""
    source = EmbeddedSource(recipe())
    name = source.scenes()[0]
    crowd = _together(source.trace(name), EmbeddedSource(recipe().model_copy(update={"seed": 8})).trace("grid-8-000"))
    scenes = {count: Scene(source.town, _first(crowd, count)) for count in (10, 50, 200)}
    rig = source.recipe.vehicle_rig
    works = [lambda scene=scene: observe(scene, rig, "cav0", 0, scene_name="s", seed=0) for scene in scenes.values()]
    return dict(zip(scenes, cpu_ms(works, repeats)))


def _together(one: Trace, other: Trace) -> Trace:
    """Return the union of the actors of two traffic runs."""
    names = {name: np.concatenate((getattr(one, name), getattr(other, name))) for name in ("category", "shape", "size")}
    moving = {
        name: np.concatenate((getattr(one, name), getattr(other, name)), axis=1)
        for name in ("present", "position", "yaw", "velocity", "acceleration", "yaw_rate")
    }
    actor = np.concatenate((one.actor, np.char.add("other_", other.actor)))
    return replace(one, actor=actor, **names, **moving)


def _first(trace: Trace, count: int) -> Trace:
    """Return the trace with `count` actors, evenly spaced in the table; "cav0" is one of them."""
    kept = np.flatnonzero(trace.present[0])
    kept = np.unique(
        np.concatenate((np.flatnonzero(trace.actor == "cav0"), kept[np.linspace(0, len(kept) - 1, count, dtype=int)]))
    )
    present = np.zeros_like(trace.present)
    present[:, kept[:count]] = trace.present[:, kept[:count]]
    return replace(trace, present=present)


def memory_mb(frames: Sequence[int]) -> dict[int, float]:
    """Return the peak memory [MB] of a process that records each number of frames."""
    found = {}
    for count in frames:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            found[count] = pool.apply(_peak_mb, (count,))
    return found


def _peak_mb(frames: int) -> float:
    small = {"lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 8, "azimuth_steps": 128}}}}
    fields = {"town": "suburb", "cavs": 4, "warmup_s": 31.0, "spins_per_scene": 100, "every_s": 0.1}
    with tempfile.TemporaryDirectory() as folder:
        wanted = Recipe.model_validate({**fields, "frames": frames, "vehicle_rig": small})
        record(EmbeddedSource(wanted), Path(folder) / "data")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def encodings() -> dict[str, dict[str, float]]:
    """Return size [kB], CPU time [ms] and PSNR [dB] (inf: lossless) of each encoding of an image of 640 x 384."""
    source = EmbeddedSource(recipe(cameras=True))
    scene = Scene(source.town, source.trace(source.scenes()[0]))
    image = observe(scene, source.recipe.vehicle_rig, "cav0", 0, scene_name="s", seed=0).images["front"]

    def saved(pixels: NDArray, kind: str, **options: object) -> Callable[[], bytes]:
        def save() -> bytes:
            data = io.BytesIO()
            Image.fromarray(pixels).save(data, kind, **options)
            return data.getvalue()

        return save

    assert image.depth_m is not None
    assert image.semantic is not None
    assert image.instance is not None
    depth, semantic, instance = image.depth_m, image.semantic, image.instance
    raw_depth = depth.tobytes()
    ways: dict[str, Callable[[], bytes]] = {
        "rgb: WebP lossless (chosen)": lambda: encode_plane("rgb", image.rgb),
        "rgb: PNG level 1": saved(image.rgb, "png", compress_level=1),
        "rgb: PNG level 6": saved(image.rgb, "png"),
        "rgb: JPEG 95 4:4:4": saved(image.rgb, "jpeg", quality=95, subsampling=0),
        "rgb: JPEG 98 4:4:4": saved(image.rgb, "jpeg", quality=98, subsampling=0),
        "rgb: WebP 95": saved(image.rgb, "webp", quality=95, method=0),
        "depth: 14 bits, shuffled, zstd (chosen)": lambda: encode_plane("depth_m", depth),
        "depth: float32, zstd": lambda: pa.Codec("zstd", compression_level=1).compress(raw_depth, asbytes=True),
        "semantic: PNG level 1 (chosen)": lambda: encode_plane("semantic", semantic),
        "instance: PNG level 1 (chosen)": lambda: encode_plane("instance", instance),
    }
    rows = {}
    for (name, way), taken in zip(ways.items(), cpu_ms(list(ways.values()), 9)):
        data = way()
        rows[name] = {"kB": len(data) / 1e3, "ms": taken}
        if name.startswith("rgb"):
            error = np.asarray(Image.open(io.BytesIO(data))).astype(np.float64) - image.rgb
            rows[name]["psnr_db"] = float(10 * np.log10(255**2 / max(float((error**2).mean()), 1e-99)))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="the two ratios alone")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    whole = whole_recording(arguments.repeats)
    figures: dict[str, Any] = {"recording": whole}
    if not arguments.quick:
        figures |= {
            "two_cores_spins_per_s": {"lidar": two_cores(False), "cameras": two_cores(True)},
            "us_per_ray": growth_with_rays(arguments.repeats),
            "ms_by_actors": growth_with_actors(arguments.repeats),
            "peak_mb_by_frames": memory_mb((64, 1600)),
            "encodings": encodings(),
        }
    if arguments.json:
        print(json.dumps(figures, indent=1))
        return
    print(f"5 vehicles + 9 roadside suites, LiDAR 64 x 1024, CPU-ms per spin, median of {arguments.repeats}")
    print(f"  bare trace of the LiDAR rays {whole['bare_ms']:.0f}")
    print(f"  whole recording {whole['lidar_ms']:.0f}: ratio {whole['lidar_over_bare']:.2f} (at most 3)")
    print(f"  with five cameras {whole['cameras_ms']:.0f}: ratio {whole['cameras_over_bare']:.2f} (at most 12)")
    if "two_cores_spins_per_s" in figures:
        lidar, cameras = figures.pop("two_cores_spins_per_s").values()
        print(
            f"  spins of all 14 agents per second on two cores {lidar:.1f} (aim 8), with cameras {cameras:.1f} (aim 4)"
        )
    for name, values in figures.items():
        if name != "recording":
            print(f"{name}: {json.dumps(values)}")


if __name__ == "__main__":
    main()
