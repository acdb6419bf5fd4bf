"""Put trained weights into the package: `python tools/ship_weights.py signs out/seed-1/weights.safetensors --half`.

They lie in the task's folder, `shipped/weights.safetensors` with the card beside it as text, `card.md`; another
network of the task has a name of its own: `--name road` makes `shipped/road.safetensors` and `road.md`. With `--half`
numbers are stored in 16 bits, which halves the file; what loads them calculates in 32 bits as ever.
"""

import argparse
from pathlib import Path

from flcav import perception
from flcav.perception.tasks import TASKS, task_named
from flcav.perception.weights import SHIPPED, load_network, read_card, save_network, write_card

PACKAGE = Path(perception.__path__[0])


def main() -> None:
    """Copy weights and card into the task's folder of the package."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--half", action="store_true")
    parser.add_argument("--name")
    arguments = parser.parse_args()
    task = task_named(arguments.task)
    network, card = load_network(task, arguments.weights), read_card(arguments.weights)
    out = PACKAGE / task.name / SHIPPED
    if arguments.name is not None:
        out = out.with_stem(arguments.name)
    out.parent.mkdir(exist_ok=True)
    save_network(task, network.half() if arguments.half else network, out, card)
    write_card(card, out.with_name("card.md") if arguments.name is None else out.with_suffix(".md"))
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB, {task.name} {card.network}, {card.parameters} parameters")


if __name__ == "__main__":
    main()
