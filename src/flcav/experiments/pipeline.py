"""The order of a run: plan, pretrain, register errors, place, edge FL, cloud FL, test; as steps for `run_steps`."""

from flcav.experiments.federating import cloud_fl, edge_fl, more_training
from flcav.experiments.placing import choose_pole, register
from flcav.experiments.planning import plan
from flcav.experiments.pretraining import pretrain
from flcav.experiments.protocol import REGIONS, Protocol
from flcav.experiments.recording import record_split
from flcav.experiments.steps import Step
from flcav.experiments.testing import test_arm, test_rounds
from flcav.federation.strategies import FEDAVG, Strategy

STAGES = ("pretrain", "grid-edge-chosen", "cloud")  # the run itself; every other arm is a comparison


def plan_step(protocol: Protocol) -> Step:
    """Return the allocation of both budgets."""
    return Step("plan", plan, {"protocol": protocol.model_dump(mode="json")}, needs=("suburb-pool",))


def shared_steps(protocol: Protocol, planned: Step) -> list[Step]:
    """Return the steps that every arm builds on: frames, plan, stage I, registered errors, chosen poles."""
    setting = protocol.model_dump(mode="json")
    steps = [_recorded(protocol, "suburb", split) for split in ("pool", "validation")]
    steps += [_recorded(protocol, town, "registry") for town in REGIONS]
    steps.append(planned)
    steps.append(Step("pretrain", pretrain, {"protocol": setting}, needs=("plan", "suburb-pool", "suburb-validation")))
    for town in REGIONS:
        registry, errors, poles = f"{town}-registry", f"{town}-errors", f"{town}-place"
        steps.append(Step(errors, register, {"town": town}, needs=("pretrain", registry)))
        steps.append(Step(poles, choose_pole, {"town": town, "protocol": setting}, needs=(errors, registry)))
        edge = protocol.recipe(town, "edge")
        steps.append(Step(f"{town}-edge", record_split, {"recipe": edge, "poles_from": (poles,)}, needs=(poles,)))
    return steps + [_recorded(protocol, town, "test") for town in REGIONS]


def edge_step(protocol: Protocol, town: str, sensor: str, strategy: Strategy = FEDAVG) -> Step:
    """Return stage II of a region with the labels that `sensor` ("chosen", "densest" or "none") helps make."""
    setting = protocol.model_dump(mode="json")
    arguments = {"town": town, "sensor": sensor, "protocol": setting, "strategy": strategy}
    needs = ("plan", "pretrain", f"{town}-place", f"{town}-edge")
    return Step(f"{town}-edge-{sensor}", edge_fl, arguments, needs=needs)


def cloud_step(protocol: Protocol, strategy: Strategy = FEDAVG) -> Step:
    """Return stage III on top of both regions' stage II; `strategy` is the edge servers' and the cloud's."""
    needs = ["plan", "pretrain"]
    for town in REGIONS:
        needs += [f"{town}-place", f"{town}-edge", f"{town}-edge-chosen"]
    arguments = {"protocol": protocol.model_dump(mode="json"), "strategy": strategy}
    return Step("cloud", cloud_fl, arguments, needs=tuple(needs))


def central_step(protocol: Protocol, name: str, source: str) -> Step:
    """Return an arm that goes on training centrally, on ground truth of `source` ("suburb" or "grid")."""
    needs = ("plan", "pretrain", "suburb-pool", "grid-edge", "grid-place")
    return Step(name, more_training, {"source": source, "protocol": protocol.model_dump(mode="json")}, needs=needs)


def test_step(arm: str, town: str) -> Step:
    """Return the evaluation of an arm in a town."""
    return Step(f"test-{arm}-{town}", test_arm, {"arm": arm, "town": town}, needs=(arm, f"{town}-test"))


def rounds_step(arm: str, town: str, frames: int) -> Step:
    """Return the evaluation of every round of an arm on some of a town's test frames."""
    arguments = {"arm": arm, "town": town, "frames": frames}
    return Step(f"rounds-{arm}-{town}", test_rounds, arguments, needs=(arm, f"{town}-test"))


def _recorded(protocol: Protocol, town: str, split: str) -> Step:
    return Step(f"{town}-{split}", record_split, {"recipe": protocol.recipe(town, split)})
