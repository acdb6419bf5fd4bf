"""Import and drive mutated OpenDRIVE maps: `python tools/mutate_maps.py --cases 10000 [--maps DIR]`.

Prints each case that ends in a traceback, a hang or more than one sentence, and a summary; exit code 1 where there was
one. `--first N --cases 1` repeats case N. The mutations are those of `tests/contract/test_mutated_maps.py`.
"""

import argparse
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "contract"))
OWN = [
    ROOT / "tests" / "data" / "cross.xodr",
    ROOT / "tests" / "data" / "cross_with_objects.xodr",
    ROOT / "recipes" / "maps" / "quarter.xodr",
]


def main() -> None:
    """Run the cases and print the summary."""
    from mutated_maps import try_map

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--maps", type=Path, help="a folder of further maps")
    parser.add_argument("--limit-s", type=int, default=60, help="for one map")
    parser.add_argument("--every", type=int, default=3, help="drive every n-th that can be imported")
    asked = parser.parse_args()
    maps = [*OWN, *(sorted(asked.maps.rglob("*.xodr")) if asked.maps else [])]
    counts, sentences, began = Counter[str](), Counter[str](), time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(asked.first, asked.first + asked.cases):
            folder = Path(scratch) / str(number)
            outcome = try_map(maps, number, folder, limit_s=asked.limit_s, every=asked.every)
            shutil.rmtree(folder)
            counts["broken" if outcome.broken else "towns" if outcome.said == "town" else "refused"] += 1
            sentences[re.sub(r"'.*?'|[\d.e+-]+", "_", outcome.said.rpartition(".xodr: ")[2])] += 1
            if outcome.broken:
                print(f"case {number}: {outcome.map}: {outcome.done}\n{outcome.broken[-1500:]}", flush=True)
    for sentence, count in sentences.most_common(40):
        print(f"{count:6d} {sentence[:160]}")
    told = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
    print(f"{asked.cases} mutated maps in {time.monotonic() - began:.0f} s: {told}")
    sys.exit(1 if counts["broken"] else 0)


if __name__ == "__main__":
    main()
