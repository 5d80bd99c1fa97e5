"""Write plans and verdicts for random cases of every suite, or compare two such folders.

    python -m tests.golden write DIR [NAME ...]
    python -m tests.golden compare DIR OTHER

Each file has plans and verdicts of one planner on one suite. Unless a change of code affects plans,
files stay equal bit for bit on one machine with the same package versions.
"""

import argparse
import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

import planner_jax as pj

NUM, SEED = 16, 12  # cases of a row, and their seed
PLANNERS = {  # of each task, the default one first
    "hit": ("exact", "bat", "bat-lite", "bat-fitted", "bat-lite-fitted", "juggle"),
    "catch": ("exact", "catch", "mpp"),
    "intercept": ("spacetime", "quick", "best", "lattice", "paper", "em", "constant"),
    "group": ("spacetime",),
    "block": ("online", "brisk", "direct", "rrt-connect", "epase", "insat", "pinsat"),
}
SLOW = ("paper", "rrt-connect", "epase", "insat", "pinsat")  # planners with few cases
OPTIONS = (  # task, option of the default planner, its values, suite
    ("hit", "effort", ("good", "best"), None),
    ("catch", "recovery", ("brake", "home"), None),
    ("hit", "recovery", ("brake", "home"), None),
    ("catch", "decide", ("greedy", "random", "given", "policy"), "triangle3"),
)

Row = dict[str, np.ndarray]


def arrays_of(prefix: str, tree: object) -> Row:
    """Return the arrays in nested dataclasses, dicts and tuples, by dotted names after `prefix`."""
    if tree is None or callable(tree):
        return {}
    if dataclasses.is_dataclass(tree):
        parts = [(field.name, getattr(tree, field.name)) for field in dataclasses.fields(tree)]
    elif isinstance(tree, dict):
        parts = list(tree.items())
    elif isinstance(tree, tuple | list):
        parts = list(enumerate(tree))
    else:
        array = np.asarray(tree)
        return {} if array.dtype == object else {prefix: array}
    nested = (arrays_of(f"{prefix}.{name}", part) for name, part in parts)
    return functools.reduce(lambda found, own: found | own, nested, {})


def plan_and_judge(
    name: str, planner: str | None, suite: str | None = None, num: int = NUM, options=None, **draws
) -> Row:
    task = getattr(pj, name)
    cases = task.draw(num, suite, SEED, **draws)
    plans = pj.plan(task.planner(*filter(None, [planner]), **(options or {})), cases)
    return arrays_of("plan", plans) | arrays_of("verdict", task.judge(cases, plans))


def differentiate_hits() -> Row:
    cases = pj.hit.draw(NUM, seed=SEED)
    found = pj.gradient(pj.hit.planner(), cases, of="stroke.time", by="racket_height")
    return arrays_of("gradient", found)


def replan(name: str, suite: str | None, changed: str) -> Row:
    task = getattr(pj, name)
    cases, planner = task.draw(NUM, suite, seed=SEED), task.planner()
    news = {changed: getattr(cases, changed)}
    return arrays_of("plan", pj.replan(planner, cases, pj.plan(planner, cases), 0.0, **news))


def rows() -> Iterator[tuple[str, Callable[[], Row]]]:
    row = functools.partial
    for name, (default, *others) in PLANNERS.items():
        label = "intercept" if name == "group" else name
        for suite in pj.task_named(name).suites:
            yield f"{label}-{default}-{suite}", row(plan_and_judge, name, default, suite)
        for other in others:
            num = 4 if other in SLOW else NUM
            yield f"{name}-{other}", row(plan_and_judge, name, other, num=num)
    for name, option, values, suite in OPTIONS:
        for value in values:
            options = {option: value}
            yield f"{name}-exact-{value}", row(plan_and_judge, name, None, suite, options=options)
    yield "hit-exact-late", row(plan_and_judge, "hit", None, delay=0.8, limit_scale=0.5)
    yield "hit-gradient", differentiate_hits
    yield "hit-replan", row(replan, "hit", None, "ball")
    yield "catch-replan", row(replan, "catch", "throws", "targets")


def write(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, compute in rows():
        path = folder / f"{name}.npz"
        if path.exists() or (names and not name.startswith(tuple(names))):
            continue
        start = time.perf_counter()
        try:
            np.savez(path, **compute())
        except Exception as error:
            print(f"{name}: {type(error).__name__}: {str(error)[:200]}", flush=True)
            continue
        print(f"{name}: {time.perf_counter() - start:.1f} s", flush=True)
        jax.clear_caches()


def compare(folder: Path, other: Path) -> bool:
    is_same = True
    for path in sorted(folder.glob("*.npz")):
        if not (other / path.name).exists():
            print(f"{path.stem}: not in {other}")
            is_same = False
            continue
        with np.load(path) as old_file, np.load(other / path.name) as new_file:
            old, new = dict(old_file), dict(new_file)
        both = old.keys() & new.keys()
        differ = sorted(name for name in both if old[name].tobytes() != new[name].tobytes())
        if differ or old.keys() != new.keys():
            is_same = False
            lost, added = sorted(old.keys() - both), sorted(new.keys() - both)
            print(f"{path.stem}: differ {differ}, lost {lost}, added {added}")
        if differ and {"plan.cost", "verdict.success"} <= both:
            for name, sum_up in (("verdict.success", np.sum), ("plan.cost", np.median)):
                print(f"    {sum_up.__name__} of {name} {sum_up(old[name])} -> {sum_up(new[name])}")
    print("the rows are the same" if is_same else "rows differ")
    return is_same


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("others", nargs="*")
    chosen = parser.parse_args()
    if chosen.action == "write":
        write(chosen.folder, chosen.others)
    else:
        sys.exit(not compare(chosen.folder, Path(chosen.others[0])))
