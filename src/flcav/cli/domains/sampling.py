"""`flcav odd sample`: recipes of scenarios inside a domain."""

from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.terminal import Answer, answer_json
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads

if TYPE_CHECKING:
    from flcav.odd.sampling import Space
    from flcav.odd.searching import Searched

ODD = typer.Argument(metavar="ODD", help="urban, rural, campus, mine, port, parking_lot, or an OpenODD file (.yaml).")
JSON = typer.Option(False, "--json", help="Print one JSON object instead.")


class Draw(StrEnum):
    """Way to draw samples, see `flcav.odd.sampling`."""

    coverage = "coverage"
    lhs = "lhs"
    sobol = "sobol"
    failures = "failures"


@answer_json
def sample(
    domain: str = ODD,
    out: Path = typer.Option(..., "--out", help="New folder for the recipes, and samples.json about them."),
    count: int = typer.Option(20, "--count", min=1, max=100_000, help="How many recipes."),
    town: list[str] = typer.Option([], "--town", help="Town; may be given several times; default: flcav's four."),
    method: Draw = typer.Option(
        Draw.coverage,
        "--method",
        help="Least covered buckets first, a Latin hypercube, scrambled Sobol points, or a search where the detector "
        "of objects fails.",
    ),
    covered: Path | None = typer.Option(
        None, "--covered", help="Folder of flcav odd cover: what its runs covered is drawn last."
    ),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights of the detector, of the method failures; default: the package's."
    ),
    seed: int = typer.Option(0, "--seed", min=0, help="Seed of the draws; recipe n has seed + n - 1."),
    openscenario: bool = typer.Option(
        False, "--openscenario", help="Also each scenario as OpenSCENARIO XML 1.2, and the towns' maps; extra `towns`."
    ),
) -> Answer:
    """Draw recipes of scenarios inside a domain: straight roads, T-junctions, cross-roads and roundabouts of towns.

    Each has a corner case at its place, in weather of the domain. `flcav record` reads the recipes. The method failures
    tests four frames of each scenario, and draws the next by what failed; stopped, the same command goes on.
    """
    use_threads(1)
    from flcav.cli.options import refuse_unused
    from flcav.config import InputError
    from flcav.odd.coverage import load_report
    from flcav.odd.domain import read_domain
    from flcav.odd.openscenario import to_openscenario
    from flcav.odd.sampling import SampledScenario, Space, count_pairs, sample_domain, write_recipes
    from flcav.odd.scenery import Scenery
    from flcav.sources.recipe import Recipe
    from flcav.storage.files import check_writable, write_bytes
    from flcav.world.map.town import TOWNS, load_town
    from flcav.world.opendrive.exporting import export_town

    if method is not Draw.coverage:
        refuse_unused(f"odd sample --method {method.value}", "covered")
    if method is not Draw.failures:
        refuse_unused(f"odd sample --method {method.value}", "weights")
    if covered is not None and not (covered / "runs").is_dir():
        raise InputError(f"{covered}: no folder that flcav odd cover has written: there are no runs in it")
    check_writable(out)
    found = read_domain(domain)
    sceneries = [Scenery(load_town(name)) for name in dict.fromkeys(town or TOWNS)]
    space = Space(found, sceneries)
    searched = _search(space, weights, count, seed, out) if method is Draw.failures else ()
    drawn = (
        count_pairs(space, [each.sample for each in searched])
        if searched
        else sample_domain(space, count, method.value, seed, None if covered is None else load_report(covered))
    )

    def write_scenario(sample: SampledScenario, recipe: Recipe, path: Path) -> None:
        if openscenario:
            path.with_suffix(".xosc").write_bytes(to_openscenario(sample, f"{sample.place.town}.xodr"))

    maps = {}
    if openscenario:
        used = {each.place.town for each in drawn.samples}
        maps = {each.town.name: export_town(each.town) for each in sceneries if each.town.name in used}
    paths = write_recipes(drawn, space.sceneries, out, seed, write_scenario, [each.failed for each in searched])
    for name, text in maps.items():
        write_bytes(out / f"{name}.xodr", text.encode())
    cells = {failure.cell for each in searched for failure in each.failures}
    frames = sum(len(each.tested) for each in searched)
    pairs = {"pairwise": drawn.pairwise, "pairs": drawn.pairs, "possible": drawn.possible}
    yield {
        "recipes": len(paths),
        **pairs,
        **({"frames": frames, "distinct_failures": len(cells)} if searched else {}),
    }
    kinds = Counter(each.place.kind for each in drawn.samples)
    yield f"{out}: {plural(len(paths), 'recipe')} in {found.name}, by {method.value}"
    yield f"    {', '.join(f'{kind}: {number}' for kind, number in kinds.most_common())}"
    yield f"    pairwise coverage {drawn.pairwise:.0%}: {drawn.pairs} of {drawn.possible} pairs of buckets"
    if searched:
        failing = plural(sum(bool(each.failures) for each in searched), "scenario")
        yield f"    {plural(len(cells), 'distinct failure')} in {plural(frames, 'frame')}, of {failing}"


def _search(space: "Space", weights: Path | None, count: int, seed: int, out: Path) -> "Sequence[Searched]":
    """Search for failures and return the tested scenarios; results are kept in the folder of the recipes."""
    from flcav.config import InputError
    from flcav.interface import progress
    from flcav.odd.searching import TESTED, search_failures
    from flcav.perception.networks import resolve_network
    from flcav.perception.objects.task import OBJECTS

    if out.exists() and any(out.glob("*.yaml")):
        raise InputError(f"{out}: has recipes already; name another folder")
    network = resolve_network(OBJECTS, weights, "cpu")
    with progress.show_progress("search") as report:
        return search_failures(space, network, count, seed, kept=out / TESTED, progress=report)
