"""The loss of imitation against independent sums, what training by it keeps, and where it is refused."""

import math
import pickle
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.perception.client import TaskClient
from flcav.perception.objects.config import CONFIGURATIONS
from flcav.perception.objects.distillation import SEEN, ImitatingObjects, imitation_loss
from flcav.perception.objects.loss import BOX_WEIGHT, DIRECTION_WEIGHT, SMOOTH_L1_BETA
from flcav.perception.objects.model import HeadOutput, Second
from flcav.perception.objects.predict import predict
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network
from flcav.perception.weights import from_arrays, to_arrays
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import resolve_settings
from flcav.runs.recipe import RunRecipe

CONFIG = CONFIGURATIONS["pillars"]


def outputs(seed: int, samples: int = 2, anchors: int = 6, bias: float = 0.0) -> HeadOutput:
    """Return random predictions of one class."""
    draw = torch.Generator().manual_seed(seed)
    score, box, direction = (torch.randn(samples, anchors, n, generator=draw) for n in (1, 7, 2))
    return HeadOutput(score + bias, box, direction)


def test_it_is_the_mean_distance_of_boxes_by_the_scores_of_the_teacher() -> None:
    student, teacher = outputs(1), outputs(2, bias=-2.0)
    total = weights = 0.0
    for sample in range(2):
        for anchor in range(6):
            score = 1 / (1 + math.exp(-float(teacher.score[sample, anchor, 0])))
            if score < SEEN:
                continue
            error = (student.box[sample, anchor] - teacher.box[sample, anchor]).tolist()
            error[6] = math.sin(error[6])
            box = sum(
                e * e / (2 * SMOOTH_L1_BETA) if abs(e) < SMOOTH_L1_BETA else abs(e) - SMOOTH_L1_BETA / 2 for e in error
            )
            wanted = np.exp(teacher.direction[sample, anchor].numpy())
            found = np.exp(student.direction[sample, anchor].numpy())
            heading = -float((wanted / wanted.sum() * np.log(found / found.sum())).sum())
            total += score * (BOX_WEIGHT * box + DIRECTION_WEIGHT * heading)
            weights += score
    assert 0 < weights < 12 * SEEN + 12
    assert float(imitation_loss(student, teacher)) == pytest.approx(total / weights, rel=1e-5)


def test_it_has_no_gradient_at_the_teacher_and_none_where_that_sees_nothing() -> None:
    teacher = outputs(3)
    same = HeadOutput(*(part.clone().requires_grad_() for part in teacher if part is not None))
    imitation_loss(same, teacher).backward()
    for part in (same.box, same.direction):
        assert part.grad is not None
        assert float(part.grad.abs().max()) < 1e-6
    assert float(imitation_loss(outputs(4), outputs(3, bias=-20))) == 0


def street(seed: int, height: float) -> Sample:
    """Return two cars of a height as boxes full of points, on the ground."""
    draw, rows = np.random.default_rng(seed), []
    places = draw.uniform((8, -12), (40, 12), (2, 2))
    for x, y in places:
        around = draw.uniform(-0.5, 0.5, (200, 3)) * (4.2, 1.8, height) + (x, y, -1.8 + height / 2)
        rows.append(np.column_stack((around, np.full(200, 0.3))))
    boxes = [(x, y, -1.8 + height / 2, 4.2, 1.8, height, 0.0) for x, y in places]
    return Sample(np.concatenate(rows).astype(np.float32), Boxes.from_array(np.array(boxes), "Car"))


def train(start: Mapping[str, np.ndarray], samples: list[Sample], task: object, steps: int) -> dict[str, np.ndarray]:
    client = TaskClient(task, CONFIG, samples)  # type: ignore[arg-type]
    return client.train(start, steps=steps, learning_rate=2e-3, seed=1).weights


def raised(boxes: Boxes) -> Boxes:
    """Return boxes that are higher by .8 m."""
    rows = boxes.array()
    rows[:, 2] += 0.4
    rows[:, 5] += 0.8
    return Boxes.from_array(rows, boxes.label)


def boxes_of(weights: Mapping[str, np.ndarray], sample: Sample, where: Tensor) -> Tensor:
    network: Second = build_network(OBJECTS, CONFIG, 1)
    from_arrays(network, weights)
    with torch.inference_mode():
        return predict(network.eval(), [sample.points]).box[where]


@pytest.mark.slow
def test_a_network_that_imitates_keeps_its_boxes_nearer_to_those_it_had() -> None:
    """It learns low cars, then the labels say that the same points are of high ones."""
    start: Second = build_network(OBJECTS, CONFIG, 1)
    low = [street(seed, 1.4) for seed in range(12)]
    learned = train(to_arrays(start), low, OBJECTS, 60)
    from_arrays(start, learned)
    high = [replace(each, boxes=raised(each.boxes)) for each in low]
    imitating = ImitatingObjects(start, 3.0)
    assert isinstance(pickle.loads(pickle.dumps(imitating)).teacher, Second)  # vehicles may be other processes
    held = street(99, 1.4)
    with torch.inference_mode():
        score = predict(start.eval(), [held.points]).score.sigmoid()[..., 0]
    where = score > 0.3
    assert where.any()
    before = boxes_of(learned, held, where)
    moved = {
        name: float((boxes_of(train(learned, high, task, 20), held, where) - before).abs().mean())
        for name, task in (("free", OBJECTS), ("imitating", imitating))
    }
    assert moved["imitating"] < 0.6 * moved["free"]
    np.testing.assert_array_equal(to_arrays(start)["head.weight"], learned["head.weight"])  # the teacher stays


@pytest.mark.parametrize(
    ("tasks", "why"),
    [
        ({"objects": {}, "signs": {}}, "training.imitation: it keeps boxes, and 'signs' has none"),
        ({"objects": {"labels": "road-average"}}, "training.imitation: the labels 'road-average' have a loss of their"),
    ],
)
def test_what_has_no_boxes_or_another_loss_is_refused(tasks: dict[str, dict[str, str]], why: str) -> None:
    plan = {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}
    recipe = RunRecipe.model_validate(
        {
            "tasks": {name: {**task, "plan": plan} for name, task in tasks.items()},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}},
            "budgets_mb": {"wireless": 90, "wireline": 90},
            "arms": {"kept": {"training": {"imitation": 1.0}}},
        }
    )
    with pytest.raises(InputError, match=why):
        check_federations(recipe, resolve_settings(recipe).values())
