"""The words of a plan, each defined once: its page and the command line show these sentences, docs repeat them."""

from flcav.optimization.allocation import resolved
from flcav.optimization.problem import Problem

MEASURES = {"weighted": "weighted error", "max-min": "largest error", "area": "area"}  # by objective, as in `TERMS`
STEPS = {  # what costs uplink megabytes
    "samples": "labelled samples go from the vehicles over a wireless link to their edge server and over a wireline to "
    "the cloud",
    "edge round": "in an edge round every vehicle sends its network to its edge server",
    "cloud round": "in a cloud round every edge server sends its network to the cloud",
}
CURVE = "A learning curve per task says how much error each of them takes away."
TERMS = {
    "error": "1 minus a task's accuracy, as its curve predicts it.",
    "weighted error": "the errors of all tasks, each times its weight, added up: their mean only where the weights sum "
    "to 1.",
    "largest error": "the error of the task that errs most.",
    "area": "that of the polygon whose corners are the tasks' accuracies on equally spaced axes; large where no task "
    "is left behind.",
    "budget": "what may go up over one type of link, from all vehicles together, during the whole training. What comes "
    "down is not counted.",
    "saved": "what a plan that is solved anew with more of one budget, the other as it is, does better than this one. "
    "Plans are in whole samples and rounds, so more megabytes help in steps.",
    "up to": "the upper band of a curve, which this plan makes least; the predicted error is the curve's own.",
    "proven": "the solver also finds a bound that no plan can be below, so how far this one could still be improved is "
    "known.",
}


def meaning(problem: Problem, objective: float) -> str:
    """Return what the problem's measure is, in a sentence; of a weighted error that is no mean, also the mean."""
    sentence = TERMS[MEASURES[problem.objective]]
    weights = sum(task.weight for task in resolved(problem).tasks)
    if problem.objective != "weighted" or abs(weights - 1) < 1e-9:
        return sentence
    return f"{sentence} Here they sum to {weights:.3g}, and the mean is {objective / weights:.4g}."
