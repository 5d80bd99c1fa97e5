"""Check that invalid cases in a batch are marked, and that they change no plan of another case.

    python -m benchmarks.poisoned_batches [--num 20000] [--task hit] [--every 100] [--seed 0]
        [--out DIR]

A batch is planned twice: as drawn, and with invalid ("poisoned") numbers in every hundredth case. A
poisoned case has one array with a bad value: NaN, infinity, or a number outside the allowed range.
The poisoned cases take turns through all arrays and bad values. A poisoned case counts as marked if
the status of its plan is BAD_INPUT. All other plans must be equal, bit for bit, in both batches.
"""

import argparse
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.benchmarks.run import Bench, argument_parser, begin
from planner_jax.core.registry import all_tasks
from planner_jax.core.rules import all_ruled
from planner_jax.planning.decided import DecidedPlanner

# Planners that decide the order and times of catches replace these arrays without reading them, so
# bad values in them have no effect.
REPLACED = ("order", "times")
BAD = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e6)


def poisons(case: Any) -> list[tuple[str, float]]:
    """Return the names of a case's arrays, each with a value that is invalid for the array."""
    found = []
    for ruled in all_ruled(jax.tree.map(np.asarray, case)):
        for value in BAD:
            if ruled.value.dtype.kind == "f" or np.isfinite(value):
                bad = np.full_like(ruled.value, value)
                if bad.size and not ruled.rule.holds(bad, ruled.part).all():
                    found.append((ruled.name, value))
    return list(dict.fromkeys(found))


def poison(cases: Any, lanes: np.ndarray, spared: Collection[str] = ()) -> Any:
    """Return a copy of a batch with an invalid number in some cases, in NumPy arrays.

    Args:
        cases: a batch.
        lanes: indices of the cases to change. Each gets the next of the values from `poisons`.
        spared: names of arrays that are not changed.
    """
    paths, tree = jax.tree_util.tree_flatten_with_path(cases)
    leaves = {
        jax.tree_util.keystr(path, simple=True, separator="."): np.array(leaf)
        for path, leaf in paths
    }
    bad = [(name, value) for name, value in poisons(pj.take(cases, 0)) if name not in spared]
    for k, lane in enumerate(lanes):
        name, value = bad[k % len(bad)]
        leaves[name][lane] = value
    return jax.tree.unflatten(tree, list(leaves.values()))


def compare(task: Any, num: int, every: int, seed: int) -> dict[str, int]:
    """Plan a valid batch and a batch with invalid cases; count marked cases and changed plans.

    Args:
        task: specification of the task.
        num: number of cases.
        every: number N; one of every N cases is made invalid.
        seed: seed of the cases.
    """
    cases, planner = task.draw(num, seed=seed), task.planner(**task.bench)
    lanes = np.arange(every // 2, num, every)
    others = np.setdiff1d(np.arange(num), lanes)
    spared = REPLACED if isinstance(planner, DecidedPlanner) else ()
    broken = jax.tree.map(jnp.asarray, poison(cases, lanes, spared))
    sound, found = jax.device_get((pj.plan(planner, cases), pj.plan(planner, broken)))
    same = np.ones(num, bool)
    for ours, theirs in zip(jax.tree.leaves(sound), jax.tree.leaves(found), strict=True):
        alike = (ours == theirs) | ((ours != ours) & (theirs != theirs))
        same &= alike.reshape(num, -1).all(axis=1)
    return {
        "poisoned": lanes.size,
        "marked": int((found.status[lanes] == pj.Status.BAD_INPUT).sum()),
        "others": others.size,
        "unchanged": int(same[others].sum()),
        "marked_others": int((found.status[others] == pj.Status.BAD_INPUT).sum()),
        "solved_others": int(pj.are_solved(found)[others].sum()),
    }


def measure(bench: Bench, options: argparse.Namespace) -> None:
    """Plan a batch with and without invalid cases, and print two counts.

    The counts are how many invalid cases are marked as invalid, and how many plans of other cases
    are equal in both batches.
    """
    task = pj.task_named(options.task)
    found = compare(task, options.num, options.every, options.seed)
    bench.row(task=options.task, num=options.num, **found)
    bench.note(**found)
    bench.count(np.arange(found["others"]) < found["solved_others"])
    bench.say(
        f"{options.task}, {options.num:,} cases, {jax.devices()[0].device_kind}: "
        f"{found['marked']:,} of {found['poisoned']:,} poisoned cases are marked; "
        f"{found['unchanged']:,} of {found['others']:,} others have the same bits, "
        f"{found['marked_others']:,} of them are marked"
    )


def main() -> None:
    parser = argument_parser("poisoned_batches", __doc__, num=20_000, every=100, seed=0)
    parser.add_argument("--task", default="hit", choices=all_tasks(), help="default: hit")
    options = parser.parse_args()
    with begin(parser, options) as bench:
        measure(bench, options)


if __name__ == "__main__":
    main()
