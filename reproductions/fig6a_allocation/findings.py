"""Findings of the comparison of two plans: verdicts on claims, as sentences with the numbers behind them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flcav.config import Json
from flcav.runs.provenance import Provenance
from flcav.runs.recipe import CLOUD, EDGE, PRETRAIN
from flcav.runs.results.run import LinkUse
from flcav.statistics.estimates import Estimate
from flcav.statistics.power import MOST_SEEDS, plan_seeds
from flcav.statistics.seeds import LEVEL, MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import HELD, NOT_HELD, UNDECIDED, Claim, Judged, judge, signed
from flcav.storage.records import Record

EQUAL, JOINT = "equal-stages", "joint"  # the plans
MEAN = "mean of towns"  # place of what the planner's history measures: the mean of the federating towns
COUNTS = ("samples", "edge_rounds", "cloud_rounds")  # keys of `Planned.counts`


@dataclass(frozen=True)
class Planned:
    """A plan's counts, its price, and the error (1 - AP50) that the learning curve predicts after the last stage."""

    samples: int
    edge_rounds: int
    cloud_rounds: int
    wireless_mb: float
    wireline_mb: float
    predicted_error: float

    @property
    def counts(self) -> dict[str, int]:
        """Return samples, edge rounds and cloud rounds by name."""
        return dict(zip(COUNTS, (self.samples, self.edge_rounds, self.cloud_rounds), strict=True))


@dataclass(frozen=True)
class StageAP:
    """AP50 after a stage."""

    ap50: float


@dataclass(frozen=True)
class AllocationSeed:
    """Results of both plans in one seed. Plans are `EQUAL` and `JOINT`; stages are pretrain, edge and cloud."""

    seed: int
    plans: Mapping[str, Planned]
    predicted: Mapping[str, Mapping[str, float]]  # AP50 by plan and stage
    realised: Mapping[str, Mapping[str, Mapping[str, StageAP]]]  # by `MEAN` or town, plan and stage
    differences: Mapping[str, Mapping[str, Estimate]]  # joint - equal by `MEAN` or town, and stage, over test scenes
    poles: Mapping[str, Mapping[str, int]]  # by plan and town
    ledger: Mapping[str, Mapping[str, LinkUse]]  # by plan and link

    @property
    def coincide(self) -> bool:
        """Return whether both plans are the same, with equal numbers of samples and rounds."""
        return self.plans[EQUAL].counts == self.plans[JOINT].counts


@dataclass(frozen=True)
class AllocationSummary:
    """Means over seeds; differences are joint minus equal stages, paired by seed."""

    predicted: Mapping[str, Mapping[str, float]]  # AP50 by plan and stage
    realised: Mapping[str, Mapping[str, Mapping[str, MeanOverSeeds]]]  # by `MEAN` or town, plan and stage
    predicted_difference: Mapping[str, float]  # by stage
    realised_difference: Mapping[str, Mapping[str, MeanOverSeeds]]  # by `MEAN` or town, and stage


@dataclass(frozen=True)
class PlanFinding:
    """A question on the plans, the verdict, and a sentence with the numbers behind it."""

    question: str
    verdict: str
    sentence: str


@dataclass(frozen=True)
class AtBudgets:
    """Results of both plans under one pair of budgets: numbers by seed, means over seeds, and findings."""

    factor: float  # of the recipe's budgets
    seeds: tuple[AllocationSeed, ...]
    summary: AllocationSummary
    findings: tuple[PlanFinding, ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the budgets, as "x 0.25"."""
        return f"x {self.factor:g}"

    @property
    def coincide(self) -> bool:
        """Return whether both plans are the same in every seed."""
        return all(seed.coincide for seed in self.seeds)


@dataclass(frozen=True)
class AllocationResult(Record):
    """Results of the comparison under several multiples of the recipe's budgets."""

    history: Mapping[str, tuple[float, float]]  # least and most of each count in the planner's history
    budgets: tuple[AtBudgets, ...]
    recipe: Mapping[str, Json]
    provenance: Provenance


STAGE_NAMES = {"pretrain": "pretraining", "edge": "edge FL", "cloud": "cloud FL"}
Gain = tuple[str, str]  # plan, stage
Ranges = Mapping[str, tuple[float, float]]
GAINS: tuple[Gain, ...] = tuple((name, stage) for name in (EQUAL, JOINT) for stage in (EDGE, CLOUD))
BETTER = "Does the joint plan beat equal shares for every stage?"
COUNT_NAMES = {"samples": "samples", "edge_rounds": "edge rounds", "cloud_rounds": "cloud rounds"}


def allocation_findings(budgets: Sequence[AtBudgets], history: Ranges) -> tuple[tuple[PlanFinding, ...], ...]:
    """Return the findings under each pair of budgets: gain, ranking by prediction, gain of every stage, accuracy, use.

    Some claims are tests over seeds: the joint plan's gain, the gains of the stages, and the exactness of predictions.
    These are judged together under all budgets. Where both plans are the same, there is nothing to judge. `history`:
    least and most of each count in the history that the plans are predicted from.
    """
    claims = [[] if results.coincide else _claims(results) for results in budgets]
    judged = iter(judge([claim for group in claims for claim in group]))
    return tuple(
        _all_findings(results, history, [next(judged) for _ in group])
        if group
        else (_one_plan(results), _budgets(results))
        for results, group in zip(budgets, claims, strict=True)
    )


def _claims(results: AtBudgets) -> list[Claim]:
    means = [results.summary.realised_difference[MEAN][CLOUD], *_stage_gains(results).values()]
    return [*map(Claim, means), _claim_exact(results)]


def _one_plan(results: AtBudgets) -> PlanFinding:
    """Return the finding where both plans are the same: no difference to judge."""
    counts = ", ".join(f"{count} {COUNT_NAMES[name]}" for name, count in results.seeds[0].plans[JOINT].counts.items())
    realised, predicted = results.summary.realised[MEAN][JOINT], results.summary.predicted[JOINT]
    sentence = (
        f"Both plans are the same, {counts}: there is no difference to judge. "
        f"In the {MEAN}, AP50 was {realised[PRETRAIN].mean:.3f} pretrained, {realised[EDGE].mean:.3f} after edge FL "
        f"and {realised[CLOUD].mean:.3f} after cloud FL (predicted: {predicted[CLOUD]:.3f})."
    )
    return _finding(BETTER, UNDECIDED, sentence)


def _all_findings(results: AtBudgets, history: Ranges, judged: Sequence[Judged]) -> tuple[PlanFinding, ...]:
    """Return the findings under one pair of budgets, from the verdicts on its claims."""
    difference, gains = results.summary.realised_difference[MEAN][CLOUD], _stage_gains(results)
    first, *others, exact = judged
    verdicts = {key: other.verdict for key, other in zip(gains, others, strict=True)}
    return (
        _better(results, difference, first),
        _ranking(results, history, difference, first),
        _every_stage(results, gains, verdicts, first.family),
        _accuracy(results, _claim_exact(results), exact),
        _budgets(results),
    )


def _stage_gains(results: AtBudgets) -> dict[Gain, MeanOverSeeds]:
    return {key: _gain(results, MEAN, *key) for key in GAINS}


def _better(results: AtBudgets, difference: MeanOverSeeds, judged: Judged) -> PlanFinding:
    realised = results.summary.realised[MEAN]
    sentence = (
        f"In the {MEAN}, AP50 after the last stage was {realised[EQUAL][CLOUD].mean:.3f} with equal stages and "
        f"{realised[JOINT][CLOUD].mean:.3f} with the joint plan: {_interval(difference)}"
    )
    if difference.seeds == 1:
        estimate = results.seeds[0].differences[MEAN][CLOUD]
        over_scenes = Estimate(estimate.mean, estimate.low, estimate.high).describe(sign=True)
        sentence += f"; {over_scenes} over test scenes of one seed, in which training does not vary."
    else:
        over = f"over {difference.seeds} seeds, paired, of standard deviation {difference.sd:.3f}"
        sentence += f" {over}; {judged.describe()}. {_needed(results, difference, judged)}"
    return _finding(BETTER, judged.verdict, sentence)


def _needed(results: AtBudgets, difference: MeanOverSeeds, judged: Judged) -> str:
    """Return a sentence: how many seeds it takes to detect the predicted difference."""
    predicted = results.summary.predicted_difference[CLOUD]
    seeds = plan_seeds(predicted, difference.sd, LEVEL / max(judged.family, 1))
    count = f"more than {MOST_SEEDS}" if seeds is None else seeds
    return f"Detecting the predicted difference of {signed(predicted)} takes {count} seeds."


def _ranking(results: AtBudgets, history: Ranges, difference: MeanOverSeeds, judged: Judged) -> PlanFinding:
    predicted = results.summary.predicted_difference[CLOUD]
    question = "Does the prediction rank the two plans rightly?"
    if predicted == 0:
        return _finding(question, UNDECIDED, "Both plans are predicted to reach the same: there is nothing to rank.")
    seeds = results.seeds
    agree = sum(predicted * (_ap(seed, JOINT, CLOUD) - _ap(seed, EQUAL, CLOUD)) > 0 for seed in seeds)
    expected = f"The curve predicts {signed(predicted)} for the joint plan; {agree} of {len(seeds)} seeds agree in sign"
    opposite = {HELD: NOT_HELD, NOT_HELD: HELD, UNDECIDED: UNDECIDED}
    decided = judged.verdict if predicted > 0 else opposite[judged.verdict]
    sure = ", but that is undecided" if decided == UNDECIDED else ""
    if difference.mean * predicted > 0:
        return _finding(question, decided, f"{expected}, and so does their mean{sure}.")
    return _finding(question, decided, f"{expected}, and their mean does not{sure}. {_why(results, history)}")


def _why(results: AtBudgets, history: Ranges) -> str:
    """Return sentences: the stage where prediction and training differ most, and the counts beyond the history."""
    summary = results.summary
    predicted = _gains(summary.predicted_difference)
    realised = _gains({stage: each.mean for stage, each in summary.realised_difference[MEAN].items()})
    stage = max(STAGE_NAMES, key=lambda name: abs(predicted[name] - realised[name]))
    sentence = (
        f"They part most in {STAGE_NAMES[stage]}: of what that stage adds, the joint plan was to have "
        f"{signed(predicted[stage])} more than equal stages, and had {signed(realised[stage])}."
    )
    beyond = [
        f"{COUNT_NAMES[count]} {plans[name].counts[count]} of the {name} plan (history: {low:g} to {high:g})"
        for count, (low, high) in history.items()
        for plans in (results.seeds[0].plans,)
        for name in (EQUAL, JOINT)
        if not low <= plans[name].counts[count] <= high
    ]
    return sentence + (f" The curve is extrapolated for {'; '.join(beyond)}." if beyond else "")


def _every_stage(
    results: AtBudgets, gains: Mapping[Gain, MeanOverSeeds], verdicts: Mapping[Gain, str], family: int
) -> PlanFinding:
    """Return the finding on the gain of each federated stage in each plan, with the prediction for those that lost."""
    plans = results.seeds[0].plans
    rounds = {(name, stage): plans[name].counts[f"{stage}_rounds"] for name, stage in gains}
    gain_parts = [
        f"{STAGE_NAMES[stage]} of the {name} plan ({rounds[name, stage]} round{'s' * (rounds[name, stage] != 1)}) "
        f"{_interval(gain)}, {verdicts[name, stage]}"
        for (name, stage), gain in gains.items()
    ]
    corrected = f", with verdicts corrected for {family} claims" if family else ""
    sentences = [f"In the {MEAN}, over the stage before it{corrected}: {'; '.join(gain_parts)}."]
    lost = [key for key, verdict in verdicts.items() if verdict == NOT_HELD]
    if lost:
        foreseen = [
            f"{signed(_foreseen(results, *key))} for {STAGE_NAMES[key[1]]} of the {key[0]} plan" for key in lost
        ]
        sentences.append(f"The curve predicted {'; '.join(foreseen)}.")
    for name, stage in (key for key in lost if key[1] == CLOUD):
        elsewhere = "; ".join(
            f"on {town} the same stage brought {_interval(_gain(results, town, name, stage))}"
            for town in results.summary.realised
            if town != MEAN
        )
        sentences.append(f"The cloud's average of all regions' networks serves them all: {elsewhere}.")
    decided = NOT_HELD if lost else HELD if set(verdicts.values()) == {HELD} else UNDECIDED
    return _finding("Did every stage raise the accuracy?", decided, " ".join(sentences))


def _gain(results: AtBudgets, town: str, name: str, stage: str) -> MeanOverSeeds:
    """Return a stage's gain over the stage before it, as the mean over seeds."""
    before = {EDGE: PRETRAIN, CLOUD: EDGE}[stage]
    rows = [seed.realised[town][name] for seed in results.seeds]
    return mean_over_seeds([row[stage].ap50 - row[before].ap50 for row in rows])


def _interval(mean: MeanOverSeeds) -> str:
    if mean.low is None or mean.high is None:
        return signed(mean.mean)
    return f"{signed(mean.mean)} ({signed(mean.low)} to {signed(mean.high)})"


def _foreseen(results: AtBudgets, name: str, stage: str) -> float:
    return _gains(results.summary.predicted[name])[stage]


def _gains(after: Mapping[str, float]) -> dict[str, float]:
    """Return the gain of each stage over the stage before it."""
    before = {"pretrain": 0.0, "edge": after["pretrain"], "cloud": after["edge"]}
    return {stage: after[stage] - before[stage] for stage in STAGE_NAMES}


def _claim_exact(results: AtBudgets) -> Claim:
    """Return the claim that predictions are off by less than the difference that they predict between the plans."""
    errors = [[abs(error) for error in seed_errors] for seed_errors in _errors(results)]
    means = [sum(seed_errors) / len(seed_errors) for seed_errors in errors]
    return Claim(mean_over_seeds(means), than=abs(results.summary.predicted_difference[CLOUD]), at_most=True)


def _errors(results: AtBudgets) -> list[list[float]]:
    """Return the AP50 after the last stage minus its prediction, by seed, for both plans."""
    return [
        [seed.realised[MEAN][name][CLOUD].ap50 - seed.predicted[name][CLOUD] for name in (EQUAL, JOINT)]
        for seed in results.seeds
    ]


def _accuracy(results: AtBudgets, claim: Claim, judged: Judged) -> PlanFinding:
    errors = [error for seed_errors in _errors(results) for error in seed_errors]
    sentence = (
        f"Over {len(errors)} runs, AP50 after the last stage was off its prediction by {claim.mean.describe()} on "
        f"average (from {signed(min(errors))} to {signed(max(errors))}), where {claim.than:.3f} are predicted to lie "
        f"between the plans; {judged.describe()}."
    )
    return _finding("Is the prediction exact enough to distinguish the plans?", judged.verdict, sentence)


def _budgets(results: AtBudgets) -> PlanFinding:
    rows = [row for seed in results.seeds for book in seed.ledger.values() for row in book.values()]
    within = all(row.used_mb <= row.budget_mb for row in rows)
    off = [row.used_mb - row.planned_mb for row in rows]
    spent = [row.used_mb / row.budget_mb for row in rows]
    sentence = (
        f"Every ledger ends {'within' if within else 'above'} its budgets, at {min(spent):.0%} to {max(spent):.0%} of "
        f"a link's; what was sent differs from the plan's price by {signed(min(off), 2)} to {signed(max(off), 2)} MB."
    )
    return _finding("Did the runs keep their budgets?", HELD if within else NOT_HELD, sentence)


def _ap(seed: AllocationSeed, name: str, stage: str) -> float:
    return seed.realised[MEAN][name][stage].ap50


def _finding(question: str, decided: str, sentence: str) -> PlanFinding:
    return PlanFinding(question, decided, sentence)
