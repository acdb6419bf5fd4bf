"""Reader of ASAM OpenSCENARIO XML: the ego vehicle's start, actors, weather and story, as a driving scenario.

It reads world positions, speed actions and lane changes, and triggers by time and distance, as `odd.openscenario`
writes them. Anything else is refused, so that no drive leaves out a part of its file.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from flcav.config import InputError, read_xml, shorten
from flcav.driving.scenarios import DrivingScenario
from flcav.driving.scripts import Aside, Entity, Pose, Script, Speed
from flcav.geometry import rotate
from flcav.world.map.town import PACKAGED
from flcav.world.shapes import SHAPES
from flcav.world.weather import NO_FOG_M, Weather

EGO_NAMES = ("ego", "hero", "egovehicle", "ego_vehicle")
CATEGORIES = {"motorbike": "motorcycle", "semitrailer": "truck", "trailer": "truck"}  # to categories of flcav
OKTAS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight")
WETNESS = {"dry": 0.0, "moist": 0.3, "wetWithPuddles": 0.6, "lowFlooded": 0.85, "highFlooded": 0.95}
INSTANT_MPS2 = 100.0  # rate of a speed change without a transition
Step = Speed | Aside


class _Reader:
    """Reader of one document."""

    def __init__(self, root: ElementTree.Element, path: Path) -> None:
        self._root, self._path = root, path
        parameters = root.iterfind("ParameterDeclarations/ParameterDeclaration")
        self._values = {f"${node.get('name')}": node.get("value", "") for node in parameters}

    def refuse(self, what: str) -> InputError:
        return InputError(f"{self._path}: {what}")

    def text(self, node: ElementTree.Element, name: str, otherwise: str | None = None) -> str:
        value = node.get(name, otherwise)
        if value is None:
            raise self.refuse(f"<{node.tag}> has no {name}")
        return self._values.get(value, value)

    def number(self, node: ElementTree.Element, name: str, otherwise: str | None = None) -> float:
        text = self.text(node, name, otherwise)
        try:
            value = float(text)
        except ValueError:
            raise self.refuse(f"{name} of <{node.tag}> is no number: {shorten(text)}") from None
        if not abs(value) < 1e6:
            raise self.refuse(f"{name} of <{node.tag}> is out of reach: {shorten(text)}")
        return value

    def scenario(self, name: str) -> DrivingScenario:
        town = self._town()
        entities = {self.text(node, "name"): node for node in self._root.iterfind("Entities/ScenarioObject")}
        if not entities:
            raise self.refuse("has no <ScenarioObject> in <Entities>")
        ego = next((name for name in entities if name.lower() in EGO_NAMES), next(iter(entities)))
        poses = dict[str, Pose]()
        speeds = dict[str, float]()
        for private in self._root.iterfind("Storyboard/Init/Actions/Private"):
            who = self.text(private, "entityRef")
            for action in private.iterfind("PrivateAction/*"):
                if action.tag == "TeleportAction":
                    poses[who] = self._pose(action)
                elif action.tag == "LongitudinalAction":
                    speeds[who] = self._speed(who, action).target
        if lost := [who for who in entities if who not in poses]:
            raise self.refuse(f"{shorten(lost[0])} has no <TeleportAction> in <Init>")
        origin = poses[ego]
        actors = tuple(
            self._entity(node, who, _relative(origin, poses[who]), speeds.get(who, 0.0))
            for who, node in entities.items()
            if who != ego
        )
        scripts = tuple(self._scripts(ego, actors, origin))
        if actors and not scripts:
            scripts = (Script(actors, (), origin=origin),)
        speed = speeds.get(ego, 0.0)
        plain = DrivingScenario(name, town, "none", "clear", 0, 0, start=origin, speed=speed, scripts=scripts)
        return plain.with_sky(self._weather())

    def _town(self) -> str:
        logic = self._root.find("RoadNetwork/LogicFile")
        if logic is None:
            raise self.refuse("names no map: no <LogicFile> in <RoadNetwork>")
        stem = Path(self.text(logic, "filepath").replace("\\", "/")).stem
        if stem in PACKAGED:
            return stem
        folder = self._path.parent / stem
        if folder.is_dir():
            return str(folder.resolve())
        raise self.refuse(
            f"its map {shorten(stem)} is no town of flcav; `flcav towns import {stem}.xodr --out {folder}` makes one "
            "beside the file"
        )

    def _pose(self, action: ElementTree.Element) -> Pose:
        position = action.find("Position")
        place = None if position is None else position.find("WorldPosition")
        if place is None:
            kind = "none" if position is None or not len(position) else position[0].tag
            raise self.refuse(f"a position is <{kind}>, and flcav reads <WorldPosition>")
        return self.number(place, "x"), self.number(place, "y"), self.number(place, "h", "0")

    def _speed(self, who: str, action: ElementTree.Element) -> Speed:
        target = action.find("SpeedAction/SpeedActionTarget/AbsoluteTargetSpeed")
        dynamics = action.find("SpeedAction/SpeedActionDynamics")
        if target is None:
            raise self.refuse(f"<{action.tag}> of {shorten(who)}: flcav reads <SpeedAction> with <AbsoluteTargetSpeed>")
        value, rate = self.number(target, "value"), INSTANT_MPS2
        if dynamics is not None and self.text(dynamics, "dynamicsShape", "step") != "step":
            amount = self.number(dynamics, "value")
            if self.text(dynamics, "dynamicsDimension") == "rate":
                rate = abs(amount)
            elif amount > 0:
                rate = -amount  # negative: a duration [s], until the previous speed is known and gives the rate
        return Speed(who, value, rate)

    def _entity(self, node: ElementTree.Element, name: str, start: Pose, speed: float) -> Entity:
        body = next((child for child in node if child.tag in ("Vehicle", "Pedestrian", "MiscObject")), None)
        if body is None:
            raise self.refuse(f"{shorten(name)} is neither <Vehicle> nor <Pedestrian>; catalogues are not read")
        word = self.text(body, "vehicleCategory", "car") if body.tag == "Vehicle" else "pedestrian"
        category = CATEGORIES.get(word, word)
        if category not in SHAPES or body.tag == "MiscObject":
            raise self.refuse(f"{shorten(name)} is a {shorten(word)}, of which flcav has none")
        box = body.find("BoundingBox/Dimensions")
        size = None
        if box is not None:
            size = (self.number(box, "length"), self.number(box, "width"), self.number(box, "height"))
            if min(size) <= 0:
                raise self.refuse(f"{shorten(name)} has no extent: its <Dimensions> must be above 0")
        known = [shape.name for shape in SHAPES[category]]
        shape = self.text(body, "name", known[0])
        return Entity(name, category, shape if shape in known else known[0], start, speed, size)

    def _scripts(self, ego: str, actors: tuple[Entity, ...], origin: Pose) -> Iterator[Script]:
        """Yield a script for each trigger; the first one has the actors."""
        groups: dict[tuple[str | None, float], list[Step]] = {}
        speeds = {actor.name: actor.speed for actor in actors}
        for group in self._root.iterfind("Storyboard/Story/Act/ManeuverGroup"):
            who = [self.text(reference, "entityRef") for reference in group.iterfind("Actors/EntityRef")]
            for event in group.iterfind("Maneuver/Event"):
                trigger = self._trigger(event, ego)
                for action in event.iterfind("Action/PrivateAction/*"):
                    for actor in who:
                        if actor == ego:
                            raise self.refuse("an action drives the ego vehicle, which drives itself in flcav")
                        if actor not in speeds:
                            raise self.refuse(f"an action is of {shorten(actor)}, which is no entity")
                        step = self._step(actor, action)
                        if isinstance(step, Speed) and step.rate < 0:
                            step = Speed(actor, step.target, abs(step.target - speeds[actor]) / -step.rate)
                        if isinstance(step, Speed):
                            speeds[actor] = step.target
                        groups.setdefault(trigger, []).append(step)
                if other := next(
                    (each.tag for each in event.iterfind("Action/*") if each.tag != "PrivateAction"), None
                ):
                    raise self.refuse(f"<{other}> in the story: flcav reads <PrivateAction>")
        for number, ((near, value), steps) in enumerate(groups.items()):
            given = () if number else actors
            timed = {"within_m": value} if near else {"begins_s": value}
            yield Script(given, tuple(steps), near=near, origin=origin, **timed)

    def _step(self, who: str, action: ElementTree.Element) -> Step:
        if action.tag == "LongitudinalAction":
            return self._speed(who, action)
        change = action.find("LaneChangeAction")
        target = None if change is None else change.find("LaneChangeTarget/RelativeTargetLane")
        if change is None or target is None:
            inner = action[0].tag if len(action) else action.tag
            raise self.refuse(f"<{inner}> of {shorten(who)}: flcav reads changes of speed and of relative lanes")
        dynamics = change.find("LaneChangeActionDynamics")
        lasts = 2.5 if dynamics is None else self.number(dynamics, "value")
        return Aside(who, round(self.number(target, "value")), max(lasts, 0.1))

    def _trigger(self, event: ElementTree.Element, ego: str) -> tuple[str | None, float]:
        conditions = list(event.iterfind("StartTrigger/ConditionGroup/Condition"))
        if len(conditions) > 1:
            raise self.refuse(f"an event has {len(conditions)} conditions; flcav reads one")
        if not conditions:
            return None, 0.0
        (condition,) = conditions
        time = condition.find("ByValueCondition/SimulationTimeCondition")
        if time is not None:
            return None, self.number(time, "value")
        near = condition.find("ByEntityCondition/EntityCondition/RelativeDistanceCondition")
        if near is None:
            kind = next((each.tag for each in condition.iter() if each.tag.endswith("Condition") and not len(each)), "")
            raise self.refuse(
                f"a condition is <{kind}>; flcav reads <SimulationTimeCondition>, <RelativeDistanceCondition>"
            )
        refs = [
            self.text(each, "entityRef")
            for each in condition.iterfind("ByEntityCondition/TriggeringEntities/EntityRef")
        ]
        both = [each for each in (*refs, self.text(near, "entityRef")) if each != ego]
        if len(both) != 1:
            raise self.refuse("a distance is that of two actors; flcav reads those to the ego vehicle")
        return both[0], self.number(near, "value")

    def _weather(self) -> Weather:
        sky = self._root.find("Storyboard/Init/Actions/GlobalAction/EnvironmentAction/Environment")
        if sky is None:
            return Weather()
        values: dict[str, float] = {}
        air, road = sky.find("Weather"), sky.find("RoadCondition")
        if air is not None:
            if (sun := air.find("Sun")) is not None:
                values["sun_elevation_deg"] = math.degrees(self.number(sun, "elevation"))
                values["sun_azimuth_deg"] = math.degrees(self.number(sun, "azimuth"))
            if (fog := air.find("Fog")) is not None:
                values["visibility_m"] = min(max(self.number(fog, "visualRange"), 5.0), NO_FOG_M)
            if (rain := air.find("Precipitation")) is not None:
                amount = self.number(rain, "precipitationIntensity", rain.get("intensity", "0"))
                values["rain_mm_h"] = amount if self.text(rain, "precipitationType", "rain") == "rain" else 0.0
            clouds = self.text(air, "fractionalCloudCover", "").removesuffix("Oktas").removesuffix("Okta")
            if clouds in OKTAS:
                values["cloud_cover"] = OKTAS.index(clouds) / 8
        if road is not None and (word := self.text(road, "wetness", "dry")) in WETNESS:
            values["wetness"] = WETNESS[word]
        try:
            return Weather(**values)
        except ValueError as error:
            raise self.refuse(f"its weather is none of flcav ({str(error).splitlines()[-2].strip()})") from None


def _relative(origin: Pose, pose: Pose) -> Pose:
    ahead, left = rotate(pose[0] - origin[0], pose[1] - origin[1], -origin[2])
    return float(ahead), float(left), pose[2] - origin[2]


def read_openscenario(path: Path, name: str) -> DrivingScenario:
    """Return the driving scenario of an OpenSCENARIO file.

    Raises `InputError` if it is no OpenSCENARIO, its map is no town of flcav, or it has elements that flcav does not
    read.
    """
    root = read_xml(path, "an OpenSCENARIO scenario")
    if root.tag != "OpenSCENARIO":
        raise InputError(f"{path}: no OpenSCENARIO, since its root is <{shorten(root.tag)}>")
    return _Reader(root, path).scenario(name)
