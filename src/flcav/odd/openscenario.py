"""Writer of scenarios as ASAM OpenSCENARIO XML 1.2: entities, their initial states, the weather, and the storyboard.

The file describes a corner case of the vehicle under test, `ego`, on one street of the town, and names its OpenDRIVE
map. When a recipe is recorded, actors are chosen from the traffic; here they have fixed places. docs/odd.md lists the
elements that are written.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

from flcav.driving.scripts import BEGINS_S, Entity, Script, Speed, write_script
from flcav.odd.sampling import SampledScenario
from flcav.world.shapes import SHAPES
from flcav.world.weather import NO_FOG_M

REVISION = (1, 2)
DATE = "1970-01-01T00:00:00"  # fixed, so that the same scenario gives the same bytes
ENDS_S = 20.0  # duration of the scenario
AXLE_M = 0.32  # height of an axle: the radius of a wheel
LUX = 120_000.0  # illuminance of the sun at the zenith
CLOUDS = ((0.125, "oneOktas"), (0.5, "fourOktas"), (0.8, "sixOktas"), (1.0, "eightOktas"))  # by greatest cloud cover


def to_openscenario(sample: SampledScenario, map_file: str) -> bytes:
    """Return a sampled scenario as OpenSCENARIO XML 1.2, with `map_file` as its OpenDRIVE map."""
    limit = max(sample.limit_kmh / 3.6, 1.0)
    script = write_script(sample.case, limit)
    ego = Entity("ego", "car", "compact", (0.0, 0.0, 0.0), limit)
    root = ElementTree.Element("OpenSCENARIO")
    major, minor = map(str, REVISION)
    about = f"{sample.case} at a {sample.place.kind} of {sample.place.town}"
    _add(root, "FileHeader", revMajor=major, revMinor=minor, date=DATE, description=about, author="flcav")
    _add(root, "CatalogLocations")
    _add(_add(root, "RoadNetwork"), "LogicFile", filepath=map_file)
    entities = _add(root, "Entities")
    for actor in (ego, *script.actors):
        _add_entity(entities, actor)
    board = _add(root, "Storyboard")
    _add_start(_add(_add(board, "Init"), "Actions"), sample, (ego, *script.actors))
    _add_story(board, script)
    _add_time(_add(_add(board, "StopTrigger"), "ConditionGroup"), "end", ENDS_S)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _add(parent: ElementTree.Element, tag: str, **attributes: str | float) -> ElementTree.Element:
    texts = {name: value if isinstance(value, str) else f"{value:.6g}" for name, value in attributes.items()}
    return ElementTree.SubElement(parent, tag, texts)


def _add_entity(entities: ElementTree.Element, actor: Entity) -> None:
    shape = next(shape for shape in SHAPES[actor.category] if shape.name == actor.shape)
    named = _add(entities, "ScenarioObject", name=actor.name)
    if actor.category == "pedestrian":
        body = _add(named, "Pedestrian", name=shape.name, pedestrianCategory="pedestrian", mass=45.0)
    else:
        body = _add(named, "Vehicle", name=shape.name, vehicleCategory=actor.category, mass=1500.0)
    box = _add(body, "BoundingBox")
    _add(box, "Center", x=0.0, y=0.0, z=shape.height / 2)
    _add(box, "Dimensions", width=shape.width, length=shape.length, height=shape.height)
    if actor.category != "pedestrian":
        _add(body, "Performance", maxSpeed=60.0, maxAcceleration=5.0, maxDeceleration=10.0)
        axles = _add(body, "Axles")
        for tag, steering, at in (("FrontAxle", 0.6, 0.3), ("RearAxle", 0.0, -0.3)):
            _add(axles, tag, maxSteering=steering, wheelDiameter=2 * AXLE_M, trackWidth=0.85 * shape.width,
                 positionX=at * shape.length, positionZ=AXLE_M)  # fmt: skip
    _add(body, "Properties")


def _add_start(actions: ElementTree.Element, sample: SampledScenario, actors: Sequence[Entity]) -> None:
    """Write the weather, and the initial poses and speeds of the actors."""
    weather = sample.weather
    sky = _add(_add(_add(actions, "GlobalAction"), "EnvironmentAction"), "Environment", name="sky")
    _add(sky, "TimeOfDay", animation="false", dateTime=DATE)
    share = next((word for most, word in CLOUDS if weather.cloud_cover <= most), "eightOktas")
    air = _add(sky, "Weather", fractionalCloudCover=share)
    up = math.radians(weather.sun_elevation_deg)
    east_of_north = math.radians(weather.sun_azimuth_deg)
    _add(air, "Sun", azimuth=east_of_north % math.tau, elevation=up, illuminance=LUX * max(math.sin(up), 0.0))
    _add(air, "Fog", visualRange=min(weather.visibility_m, NO_FOG_M))
    kind = "rain" if weather.rain_mm_h > 0 else "dry"
    _add(air, "Precipitation", precipitationType=kind, precipitationIntensity=weather.rain_mm_h)
    _add(sky, "RoadCondition", frictionScaleFactor=1.0 - 0.4 * weather.wetness, wetness=_wet_word(weather.wetness))
    x, y, yaw = sample.place.start
    for actor in actors:
        ahead, left, turned = actor.start
        private = _add(actions, "Private", entityRef=actor.name)
        at = _add(_add(_add(private, "PrivateAction"), "TeleportAction"), "Position")
        place_x = x + ahead * math.cos(yaw) - left * math.sin(yaw)
        place_y = y + ahead * math.sin(yaw) + left * math.cos(yaw)
        _add(at, "WorldPosition", x=f"{place_x:.3f}", y=f"{place_y:.3f}", z="0", h=f"{yaw + turned:.6f}")
        _add_speed(_add(private, "PrivateAction"), actor.speed, "step", "time", 0.0)


def _wet_word(wetness: float) -> str:
    levels = ((0.1, "dry"), (0.4, "moist"), (0.7, "wetWithPuddles"), (0.9, "lowFlooded"))
    return next((word for most, word in levels if wetness < most), "highFlooded")


def _add_speed(action: ElementTree.Element, target: float, shape: str, dimension: str, value: float) -> None:
    speed = _add(_add(action, "LongitudinalAction"), "SpeedAction")
    _add(speed, "SpeedActionDynamics", dynamicsShape=shape, dynamicsDimension=dimension, value=value)
    _add(_add(speed, "SpeedActionTarget"), "AbsoluteTargetSpeed", value=target)


def _add_story(board: ElementTree.Element, script: Script) -> None:
    act = _add(_add(board, "Story", name="corner_case"), "Act", name="act")
    for number, action in enumerate(script.actions, start=1):
        group = _add(act, "ManeuverGroup", maximumExecutionCount="1", name=f"group_{number}")
        _add(_add(group, "Actors", selectTriggeringEntities="false"), "EntityRef", entityRef=action.actor)
        event = _add(_add(group, "Maneuver", name=f"manoeuvre_{number}"), "Event", name=f"event_{number}",
                     priority="override", maximumExecutionCount="1")  # fmt: skip
        private = _add(_add(event, "Action", name=f"action_{number}"), "PrivateAction")
        if isinstance(action, Speed):
            _add_speed(private, action.target, "linear", "rate", action.rate)
        else:
            change = _add(_add(private, "LateralAction"), "LaneChangeAction")
            _add(change, "LaneChangeActionDynamics", dynamicsShape="sinusoidal", dynamicsDimension="time",
                 value=action.within_s)  # fmt: skip
            _add(
                _add(change, "LaneChangeTarget"), "RelativeTargetLane", entityRef=action.actor, value=str(action.lanes)
            )
        begins = _add(_add(event, "StartTrigger"), "ConditionGroup")
        if script.near is None:
            _add_time(begins, f"begin_{number}", BEGINS_S)
        else:
            _add_near(begins, f"near_{number}", script.near, script.within_m)
    _add_time(_add(_add(act, "StartTrigger"), "ConditionGroup"), "start", 0.0)


def _add_time(group: ElementTree.Element, name: str, at_s: float) -> None:
    condition = _add(group, "Condition", name=name, delay=0.0, conditionEdge="none")
    _add(_add(condition, "ByValueCondition"), "SimulationTimeCondition", value=at_s, rule="greaterOrEqual")


def _add_near(group: ElementTree.Element, name: str, actor: str, within_m: float) -> None:
    condition = _add(group, "Condition", name=name, delay=0.0, conditionEdge="none")
    by = _add(condition, "ByEntityCondition")
    _add(_add(by, "TriggeringEntities", triggeringEntitiesRule="any"), "EntityRef", entityRef="ego")
    _add(
        _add(by, "EntityCondition"),
        "RelativeDistanceCondition",
        entityRef=actor,
        relativeDistanceType="euclidianDistance",
        value=within_m,
        freespace="false",
        rule="lessThan",
        coordinateSystem="entity",
    )
