"""Write the plans and verdicts of every suite to a folder, or compare two such folders.

    python -m tests.golden write DIR [NAME ...]
    python -m tests.golden compare DIR OTHER

A change of the layout must leave every row as it is, bit for bit. Rows of two folders are
comparable if one machine wrote both with the same package versions.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

import planner_jax as pj

NUM = 16  # cases a row
SEED = 12


def fields_of(prefix: str, tree: object) -> dict[str, np.ndarray]:
    """Return the arrays of a plan or a verdict by their path of field names.

    Args:
        prefix: path of the tree itself.
        tree: a dataclass, a tuple, an array, or a value that NumPy can hold.
    """
    if tree is None or callable(tree):
        return {}
    if dataclasses.is_dataclass(tree):
        parts = ((field.name, getattr(tree, field.name)) for field in dataclasses.fields(tree))
    elif isinstance(tree, dict):
        parts = ((str(key), value) for key, value in tree.items())
    elif isinstance(tree, tuple | list):
        parts = ((str(k), value) for k, value in enumerate(tree))
    else:
        array = np.asarray(tree)
        return {} if array.dtype == object else {prefix: array}
    found = {}
    for name, part in parts:
        found.update(fields_of(f"{prefix}.{name}", part))
    return found


def plan_and_judge(task: object, planner: object, cases: object) -> dict[str, np.ndarray]:
    """Return the plans and verdicts of a batch as named arrays."""
    plans = pj.plan(planner, cases)
    return {**fields_of("plan", plans), **fields_of("verdict", task.judge(cases, plans))}


def hit_gradient() -> dict[str, np.ndarray]:
    """Return contact times of hits, and their gradients by the height of the racket."""
    cases = pj.hit.draw(NUM, seed=SEED)
    found = pj.gradient(pj.hit.planner(), cases, of="stroke.time", by="racket_height")
    return fields_of("gradient", found)


def catch_replans() -> dict[str, np.ndarray]:
    """Return plans of catches that start from other plans."""
    cases = pj.catch.draw(NUM, "throws", seed=SEED)
    planner = pj.catch.planner()
    plans = pj.plan(planner, cases)
    return fields_of("plan", pj.replan(planner, cases, plans, 0.0, targets=cases.targets))


def hit_replans() -> dict[str, np.ndarray]:
    """Return plans of hits that start from other plans."""
    cases = pj.hit.draw(NUM, seed=SEED)
    planner = pj.hit.planner()
    plans = pj.plan(planner, cases)
    return fields_of("plan", pj.replan(planner, cases, plans, 0.0, ball=cases.ball))


def rows() -> Iterator[tuple[str, Callable[[], dict[str, np.ndarray]]]]:
    """Yield the name of every row, and the function that computes it."""
    planners = {
        "hit": ("exact", "bat", "bat-lite", "juggle"),
        "catch": ("exact", "catch", "mpp"),
        "intercept": ("spacetime", "quick", "best", "lattice", "paper", "em", "constant"),
        "group": ("spacetime",),
        "block": ("online", "brisk", "direct", "rrt-connect", "epase", "insat"),
    }
    for name, (usual, *others) in planners.items():
        task, spec = getattr(pj, name), pj.task_named(name)
        # Rows of groups were written when these were interceptions.
        row = "intercept" if name == "group" else name
        for suite in spec.suites:
            yield (
                f"{row}-{usual}-{suite}",
                lambda task=task, suite=suite, planner=usual: plan_and_judge(
                    task, task.planner(planner), task.draw(NUM, suite, SEED)
                ),
            )
        for other in others:
            num = 4 if other in ("paper", "rrt-connect", "epase", "insat") else NUM
            yield (
                f"{name}-{other}",
                lambda task=task, other=other, num=num: plan_and_judge(
                    task, task.planner(other), task.draw(num, None, SEED)
                ),
            )
    for effort in ("good", "best"):
        yield (
            f"hit-exact-{effort}",
            lambda effort=effort: plan_and_judge(
                pj.hit, pj.hit.planner(effort=effort), pj.hit.draw(NUM, seed=SEED)
            ),
        )
    yield (
        "hit-exact-late",
        lambda: plan_and_judge(
            pj.hit, pj.hit.planner(), pj.hit.draw(NUM, seed=SEED, delay=0.8, limit_scale=0.5)
        ),
    )
    for recovery in ("brake", "home"):
        yield (
            f"catch-exact-{recovery}",
            lambda recovery=recovery: plan_and_judge(
                pj.catch, pj.catch.planner(recovery=recovery), pj.catch.draw(NUM, seed=SEED)
            ),
        )
        yield (
            f"hit-exact-{recovery}",
            lambda recovery=recovery: plan_and_judge(
                pj.hit, pj.hit.planner(recovery=recovery), pj.hit.draw(NUM, seed=SEED)
            ),
        )
    for decide in ("greedy", "random", "given", "policy"):
        yield (
            f"catch-exact-{decide}",
            lambda decide=decide: plan_and_judge(
                pj.catch, pj.catch.planner(decide=decide), pj.catch.draw(NUM, "triangle3", SEED)
            ),
        )
    yield "hit-gradient", hit_gradient
    yield "hit-replan", hit_replans
    yield "catch-replan", catch_replans


def write(folder: Path, names: list[str]) -> None:
    """Write the rows of these names, or all of them, that the folder does not have."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, compute in rows():
        path = folder / f"{name}.npz"
        if path.exists() or (names and not any(name.startswith(each) for each in names)):
            continue
        begin = time.perf_counter()
        try:
            found = compute()
        except Exception as error:
            print(f"{name}: {type(error).__name__}: {str(error)[:200]}", flush=True)
            continue
        np.savez(path, **found)
        print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)
        jax.clear_caches()


def compare(folder: Path, other: Path) -> bool:
    """Print each row in which two folders differ; return whether they are the same."""
    same = True
    for path in sorted(folder.glob("*.npz")):
        if not (other / path.name).exists():
            print(f"{path.stem}: not in {other}")
            same = False
            continue
        with np.load(path) as first, np.load(other / path.name) as second:
            lost = sorted(set(first.files) - set(second.files))
            added = sorted(set(second.files) - set(first.files))
            differ = [
                name
                for name in first.files
                if name in second.files and first[name].tobytes() != second[name].tobytes()
            ]
            if lost or added or differ:
                same = False
                print(f"{path.stem}: differ {differ}, lost {lost}, added {added}")
            if differ and "plan.cost" in first.files and "verdict.success" in first.files:
                print(
                    f"    success {first['verdict.success'].sum()} -> "
                    f"{second['verdict.success'].sum()}, median cost "
                    f"{np.median(first['plan.cost'])} -> {np.median(second['plan.cost'])}"
                )
    print("the rows are the same" if same else "rows differ")
    return same


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("others", nargs="*")
    options = parser.parse_args()
    if options.action == "write":
        write(options.folder, options.others)
    else:
        sys.exit(not compare(options.folder, Path(options.others[0])))


if __name__ == "__main__":
    main()
