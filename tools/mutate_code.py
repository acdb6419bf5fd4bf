"""Mutation testing: change the package's code in one place at a time, and see whether a test fails.

    python tools/mutate_code.py --mutants 20 --seed 1 --out out/mutants.jsonl
    python tools/mutate_code.py --mutants 30 --package releases --out out/mutants.jsonl

A mutant turns a comparison, moves a number, leaves out a check, exchanges `and` and `or`, or exchanges two operators
of arithmetic. It is run with those test files of its package that execute its line, by coverage measured once; a
line that none executes in the process of the tests is run with all of them, since commands and servers run in others.
Mutants are drawn by the seed; results are appended to the file, and those that it has are not run again. The table
at the end counts killed and survived mutants by package, and lists the survivors. Some are equivalent to the original:
that is judged by reading. Not part of the tests, since it takes hours.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMIT_S = 600.0  # of the tests of a mutant, after which it counts as killed: it hangs
FEDERATION = "tests/unit/federation"
FLEET = [f"{FEDERATION}/test_fleet_*.py", f"{FEDERATION}/test_vehicle_app.py", f"{FEDERATION}/test_deadline.py"]
PACKAGES: dict[str, tuple[list[str], list[str]]] = {  # name: (sources, tests)
    "messages": (
        ["federation/wire.py", "federation/acceptance.py", "federation/conduct.py"],
        [FEDERATION, "tests/contract/test_strategies.py", "tests/contract/test_replies.py"],
    ),
    "secure": (["federation/secure", "federation/modes/masked.py"], [FEDERATION]),
    "fleet": (["fleet"], FLEET),
    "links": (["federation/links"], [FEDERATION]),
    "privacy": (["federation/privacy.py"], [FEDERATION]),
    "releases": (["releases"], ["tests/unit/releases"]),
    "carla": (["carla/server"], ["tests/unit/carla", "tests/integration/test_carla_server.py"]),
    "driving": (
        [
            "driving/measures.py",
            "driving/loop.py",
            "driving/driver.py",
            "driving/following.py",
        ],
        ["tests/unit/driving"],
    ),
    "odd": (
        ["odd/judge.py", "odd/coverage.py", "odd/cells.py", "odd/measure.py"],
        ["tests/unit/odd"],
    ),
}
TURNED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.Add: ast.Sub, ast.Sub: ast.Add,
    ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
MARKER = """
import coverage, pytest
@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    coverage.Coverage.current().switch_context(str(item.path))
    return (yield)
"""


@dataclass(frozen=True)
class Mutant:
    """A change of one expression of a file."""

    package: str
    file: str  # relative to the repository
    line: int  # from 1, of the expression
    column: int  # from 0 [bytes of UTF-8]
    old: str
    new: str
    kind: str
    everywhere: bool  # runs when the module is imported, not in a function
    tests: int = 0  # files run
    killed: bool = False
    seconds: float = 0.0

    @property
    def key(self) -> tuple[str, int, int, str]:
        """The place and the new code, which name a mutant across runs."""
        return self.file, self.line, self.column, self.new


def list_mutants(package: str, path: Path) -> Iterator[Mutant]:
    """Yield the mutants of a file, in the order of its syntax tree."""
    source = path.read_text()
    tree = ast.parse(source)
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for node in ast.walk(tree):
        above = []
        while (at := parents.get(above[-1] if above else node)) is not None:
            above.append(at)
        if any(isinstance(at, ast.JoinedStr) for at in above):
            continue  # places within f-strings are not known before Python 3.12
        in_function = any(isinstance(at, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) for at in above)
        for target, new, kind in mutate(node):
            old = ast.get_source_segment(source, target)
            if old:
                place = (str(path.relative_to(ROOT)), target.lineno, target.col_offset)
                yield Mutant(package, *place, old, new, kind, not in_function)


def mutate(node: ast.AST) -> Iterator[tuple[ast.expr, str, str]]:
    """Yield the expression to replace, its new code and the kind of the change, for each mutation of a node."""
    if isinstance(node, ast.Compare):
        for place, operator in enumerate(node.ops):
            turned = [*node.ops[:place], TURNED[type(operator)](), *node.ops[place + 1 :]]
            yield node, f"({ast.unparse(ast.Compare(node.left, turned, node.comparators))})", "comparison"
    elif isinstance(node, ast.BoolOp):
        yield node, f"({ast.unparse(ast.BoolOp(TURNED[type(node.op)](), node.values))})", "logic"
    elif isinstance(node, ast.BinOp) and type(node.op) in TURNED:
        if not any(isinstance(side, ast.Constant) and isinstance(side.value, str) for side in (node.left, node.right)):
            yield node, f"({ast.unparse(ast.BinOp(node.left, TURNED[type(node.op)](), node.right))})", "arithmetic"
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        yield node, repr(node.value + 1 if isinstance(node.value, int) else node.value * 1.25 + 0.01), "number"
    elif isinstance(node, ast.If) and any(isinstance(inner, ast.Raise) for inner in node.body):
        yield node.test, "False", "check left out"


def apply(mutant: Mutant, source: str) -> str:
    """Return the source of a file with the mutant's expression replaced; columns count bytes of UTF-8."""
    lines = source.encode().splitlines(keepends=True)
    start = sum(map(len, lines[: mutant.line - 1])) + mutant.column
    whole, old = b"".join(lines), mutant.old.encode()
    if whole[start : start + len(old)] != old:
        raise ValueError(f"{mutant.file}:{mutant.line} is not {mutant.old!r}")
    return (whole[:start] + mutant.new.encode() + whole[start + len(old) :]).decode()


def run_tests(copy: Path, tests: list[str], coverage: list[str], limit_s: float | None) -> bool:
    """Run tests in the copy; return whether all passed within the time limit."""
    environment = os.environ | {"PYTHONPATH": f"{copy / 'src'}:{copy}", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", *coverage, "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    # a group of its own: what the tests have started ends with them
    with subprocess.Popen(
        command, cwd=copy, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
    ) as process:
        try:
            output, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            return False
    if limit_s is None and process.returncode:
        raise SystemExit(f"the tests fail without a mutant:\n{output.decode()[-3000:]}")
    return process.returncode == 0


def measure_coverage(copy: Path, package: str, slow: bool) -> tuple[dict[tuple[str, int], set[str]], list[str]]:
    """Return the test files that execute each line of a package's sources, and all of its test files."""
    import coverage

    sources, patterns = PACKAGES[package]
    tests = sorted({str(path) for pattern in patterns for path in copy.glob(pattern)})
    data = copy / f".coverage-{package}"
    (copy / "mark_contexts.py").write_text(MARKER)
    (copy / "coverage.ini").write_text(f"[run]\nsource = {copy / 'src'}\ndata_file = {data}\n")
    marks = [] if slow else ["-m", "not slow"]
    run_tests(copy, ["-p", "mark_contexts", *marks, *tests], ["coverage", "run", "--rcfile=coverage.ini", "-m"], None)
    read = coverage.CoverageData(str(data))
    read.read()
    files: dict[tuple[str, int], set[str]] = defaultdict(set)
    for path in read.measured_files():
        relative = str(Path(path).relative_to(copy))
        if any(relative.startswith(f"src/flcav/{source}") for source in sources):
            for line, contexts in read.contexts_by_lineno(path).items():
                files[relative, line] |= {context for context in contexts if context}
    return files, tests


def main() -> None:
    """Run the mutants and print the table of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=20, help="of each package")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--package", action="append", choices=PACKAGES, help="again for more; all without it")
    parser.add_argument("--slow", action="store_true", help="tests marked slow, too")
    parser.add_argument("--out", type=Path, required=True, help="results, a JSON object a line")
    asked = parser.parse_args()
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    kept = [Mutant(**json.loads(line)) for line in asked.out.read_text().splitlines()] if asked.out.exists() else []
    finished = {mutant.key for mutant in kept}
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "flcav"
        names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
        for name in filter(None, names.split("\0")):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name, follow_symlinks=False)
        for package in asked.package or PACKAGES:
            drawn = draw_mutants(package, asked.mutants, asked.seed)
            if {mutant.key for mutant in drawn} <= finished:
                continue
            executing, tests = measure_coverage(copy, package, asked.slow)
            for mutant in drawn:
                if mutant.key in finished:
                    continue
                files = set() if mutant.everywhere else executing.get((mutant.file, mutant.line), set())
                done = try_mutant(copy, mutant, sorted(files) or tests, asked.slow)
                kept.append(done)
                with asked.out.open("a") as file:
                    file.write(json.dumps(asdict(done)) + "\n")
                print("killed  " if done.killed else "SURVIVED", describe(done), flush=True)
    print_table(kept)


def draw_mutants(package: str, count: int, seed: int) -> list[Mutant]:
    """Draw mutants of a package's sources without replacement."""
    paths = [ROOT / "src/flcav" / source for source in PACKAGES[package][0]]
    modules = [module for path in paths for module in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    every = [mutant for module in modules for mutant in list_mutants(package, module)]
    return random.Random(f"{seed} {package}").sample(every, min(count, len(every)))


def try_mutant(copy: Path, mutant: Mutant, tests: list[str], slow: bool) -> Mutant:
    """Return the mutant with whether the tests kill it; the copy is as before."""
    path = copy / mutant.file
    source = path.read_text()
    path.write_text(apply(mutant, source))
    began = time.monotonic()
    try:
        passed = run_tests(copy, [*([] if slow else ["-m", "not slow"]), *tests], [], LIMIT_S)
    finally:
        path.write_text(source)
    outcome = {"tests": len(tests), "killed": not passed, "seconds": round(time.monotonic() - began, 1)}
    return Mutant(**(asdict(mutant) | outcome))


def describe(mutant: Mutant) -> str:
    """Return the place and the change in a line."""
    return f"{mutant.file}:{mutant.line} {mutant.kind}: {mutant.old!r} -> {mutant.new!r}"


def print_table(mutants: list[Mutant]) -> None:
    """Print the counts by package, and the survivors."""
    print("\n| package | mutants | killed | survived |\n|---|---|---|---|")
    for package in dict.fromkeys(mutant.package for mutant in mutants):
        of = [mutant for mutant in mutants if mutant.package == package]
        killed = sum(mutant.killed for mutant in of)
        print(f"| {package} | {len(of)} | {killed} | {len(of) - killed} |")
    killed = sum(mutant.killed for mutant in mutants)
    print(f"| all | {len(mutants)} | {killed} | {len(mutants) - killed} |\n")
    for mutant in mutants:
        if not mutant.killed:
            print(f"{describe(mutant)} ({mutant.tests} test files)")


if __name__ == "__main__":
    main()
