"""Random calls of every public function, which must return or raise an error of the library.

`python -m tests.faults.random_calls --num 100000 --seed 0` prints the number of calls by outcome,
and each kind of raw error with its first call. A call starts from valid arguments and replaces some
of them. Functions that would compile a program get an unusable planner, case or plan each time.
"""

import argparse
import contextlib
import decimal
import inspect
import random
import re
import signal
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import planner_jax as pj
from planner_jax.core.tasks import all_tasks

LONGEST = 20  # [s] of one call
# Functions that compile programs, and the arguments of which one is always unusable.
COMPILING = {
    "pj.plan": ("planner", "cases"),
    "pj.solve": ("planner", "cases"),
    "pj.gradient": ("planner", "cases"),
    "pj.sensitivity": ("planner", "cases"),
    "pj.optimal_plan": ("planner", "case"),
    "pj.replan": ("planner", "cases"),
    "pj.warm_up": ("planner", "cases"),
    "pj.show": ("case", "plan"),
    "pj.live.Server": ("planner",),
    "pj.live.LivePlanner": ("planner",),
}
# Public names that change the process, start a server, or wait for its answers.
LEFT_OUT = {"pj.keep_compiled_programs", "pj.live.Server", "pj.live.Client", "pj.live.LivePlanner"}

# Functions whose further arguments go to another function.
PASSED_ON = {
    "pj.rally.case": pj.hit.case,
    "pj.team.case": pj.catch.case,
    "pj.group.case": pj.intercept.case,
}


def unusable() -> list[object]:
    """Return values that no argument of an array, number, name or object admits."""
    return [
        *(object(), "x", "", "\udcff", "a\0b", b"x", b"1", 1j, int, len, {}, {"a": 1}, {1, 2}),
        *(iter([1]), lambda: 0, decimal.Decimal(1), np.datetime64("2020"), ...),
        *([[1, 2], [3]], ((1, 2), (3,)), [1, "a"], [None], [[]], [object()], [b"x"]),
        *(np.array(["a"]), np.array([None]), np.zeros(3, complex), np.zeros((2, 2, 2, 2))),
        *(np.ma.masked_equal([1.0, 2.0, 3.0], 2.0), np.zeros(2, "V8"), np.zeros((3, 0))),
        *(Path("gone"), Path("\udcff"), jax, range(0), memoryview(b"abc")),
    ]


def odd() -> list[object]:
    """Return values that some arguments admit and others do not."""
    return [
        *(None, True, False, 0, -1, 1, 3, 2**70, 1.5, -0.5, np.nan, np.inf, -np.inf, 1e300, 1e-320),
        *(np.float32(10), np.float64(0.5), np.int64(2), np.bool_(True), np.uint8(3)),
        *((), [], (1, 2), (1, 2, 3), [0.0, 0.0, 1.0], (np.nan, 0, 1), [(0, 0, 1), (1, 1, 1)]),
        *(np.zeros(3), np.zeros(2), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 9, 3)), np.eye(3)),
        *(np.ones((2, 3)), np.ones((2, 4, 3)), np.ones((1, 3)), np.zeros((2, 2)), np.zeros(6)),
        *(np.zeros((2, 3), np.float16), np.zeros((2, 3), int), np.array(1.0), np.zeros((0,), int)),
        *(
            jnp.zeros(3),
            jnp.zeros((2, 3)),
            jnp.zeros((0, 3)),
            jnp.float32(1.0),
            range(3),
            "7",
            "1e3",
        ),
    ]


def make_valid() -> dict[str, dict[str, object]]:
    """Return valid arguments by the name of each function that needs some."""
    from tests.faults.test_bad_calls import ball_path, make_plans, turning
    from tests.trees import as_numpy

    draws = {name: as_numpy(getattr(pj, name).draw(2)) for name in ("hit", "catch", "block")}
    draws["intercept"] = as_numpy(pj.intercept.draw(2))
    plans = make_plans()
    hits, hit_plans, ball = draws["hit"], plans["hit_plans"], pj.take(draws["hit"].ball, 0)
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    exact, times = pj.hit.planner(), np.linspace(0.0, 0.5, 9)
    flight = np.stack([3 - 4 * times, 0 * times, 1 + 3 * times - 4.9 * times**2], 1)
    planned = {"planner": exact, "cases": hits}
    table = pj.predict_path(ball, 1.0, drag=0.06, gravity=9.8, num_nodes=8)
    served = {"ball_pos": (0, 5, 1), "ball_vel": (0, -5, 4)}
    valid: dict[str, dict[str, object]] = {
        "pj.fly": {"ball": ball, "duration": 1.0, "drag": 0.06, "gravity": 9.8, "num_steps": 8},
        "pj.predict_path": {
            **{"ball": ball, "horizon": 1.0, "drag": 0.06, "gravity": 9.8, "num_nodes": 8}
        },
        "pj.table_path": {"times": (0.0, 0.5, 1.0), "positions": np.eye(3)},
        "pj.are_solved": {"plans": hit_plans},
        "pj.take": {"tree": hits, "index": 0},
        "pj.task_named": {"name": "hit"},
        "pj.require_sound": {"cases": hits},
        "pj.obstacles": {"polygons": [square]},
        "pj.plan": planned,
        "pj.solve": planned,
        "pj.warm_up": planned,
        "pj.gradient": {**planned, "of": "cost", "by": "target"},
        "pj.sensitivity": planned,
        "pj.optimal_plan": {"planner": exact, "case": pj.take(hits, 0)},
        "pj.replan": {**planned, "previous": hit_plans, "elapsed": 0.1, "ball": hits.ball},
        "pj.show": {"case": pj.take(hits, 0), "plan": pj.take(hit_plans, 0)},
        "pj.export": {"plan": pj.take(hit_plans, 0), "to": "csv", "out": Path("out.csv")},
        "pj.robot_named": {"name": "x500"},
        "pj.ball.fit": {"times": times, "positions": flight},
        "pj.hit.case": {**served, "target": (0, 4, 0)},
        "pj.rally.case": {**served, "places": [(0, 4, 2), (0, 4, 2)]},
        "pj.catch.case": {"targets": ball_path(2), "horizon": (2.0, 2.0)},
        "pj.team.case": {
            **{"targets": ball_path(2), "horizon": (2.0, 2.0), "starts": [(0, 0, 1), (3, 0, 1)]}
        },
        "pj.intercept.case": {"target": pj.take(turning(1), 0)},
        "pj.intercept.observe": {"cases": draws["intercept"], "seed": 0},
        "pj.intercept.predict": {"times": times, "positions": flight[:, :2]},
        "pj.fit_drag": {
            **{"times": times, "attitudes": np.tile((1.0, 0, 0, 0), (9, 1)), "thrusts": times + 9},
            "positions": flight,
        },
        "pj.evaluate": {"trajectory": pj.take(hit_plans, 0).trajectory, "time": 0.1},
        "pj.target_at": {"table": table, "time": 0.1},
        "pj.pending": {"violation": np.zeros(2)},
        "pj.outcome": {"cost": np.zeros(2), "violation": np.zeros(2)},
        "pj.reach.case": {"goal": np.zeros(6)},
        "pj.reach.solve_pose": {"position": (0.5, 0, 0.5), "rotation": np.eye(3)},
        "pj.group.case": {"targets": turning(3)},
        "pj.block.case": {"ball_pos": (4, 0, 1), "ball_vel": (-8, 0, 2)},
    }
    for task, cases in draws.items():
        made = plans[f"{'drive' if task == 'intercept' else task}_plans"]
        valid[f"pj.{task}.judge"] = {"cases": cases, "plans": made}
        valid[f"plan of {task}.sample"] = {"rate": 100.0}
    valid["objects"] = {
        "values": [exact, pj.block.planner(), hits, hit_plans, *draws.values(), ball, ball_path(2)]
        + [turning(1), square, pj.robot_named("x500"), pj.block.paper_scene(), pj.Attempt()]
    }
    return valid


def find_public(valid: dict) -> Iterator[tuple[str, Callable]]:
    """Yield name and function of every public function, and of classes that check their fields."""
    modules = {"pj": pj, "pj.ball": pj.ball, "pj.live": pj.live}
    modules |= {f"pj.{name}": getattr(pj, name) for name in all_tasks()}
    for prefix, module in modules.items():
        for name in module.__all__:
            function, whole = getattr(module, name), f"{prefix}.{name}"
            if inspect.ismodule(function) or not callable(function) or whole in LEFT_OUT:
                continue
            is_checked = not inspect.isclass(function) or hasattr(function, "__post_init__")
            if is_checked and not (inspect.isclass(function) and issubclass(function, Exception)):
                yield whole, function
    for name in valid:
        if name.startswith("plan of "):
            task = name.removeprefix("plan of ").removesuffix(".sample")
            yield name, pj.take(valid[f"pj.{task}.judge"]["plans"], 0).sample


class _Late(BaseException):
    """A call took longer than LONGEST seconds."""


@contextlib.contextmanager
def limit_time() -> Iterator[None]:
    """Raise `_Late` in the body after LONGEST seconds."""

    def stop(*_: object) -> None:
        raise _Late

    usual = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LONGEST)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, usual)


def call_randomly(num: int, seed: int) -> tuple[Counter, dict[str, str]]:
    """Make random calls; return the number of each outcome, and a call of each raw error."""
    valid, rng = make_valid(), random.Random(seed)
    objects = valid.pop("objects")["values"]
    fit = valid["pj.ball.fit"]
    lowest = fit["positions"][:, 2].min()
    for floor in (None, lowest, lowest - 1e3):
        pj.ball.fit(**fit, floor=floor)  # compiles its programs before a call is timed
    functions = list(find_public(valid))
    outcomes: Counter = Counter()
    raw: dict[str, str] = {}
    for _ in range(num):
        name, function = rng.choice(functions)
        parameters = list(inspect.signature(function).parameters.values())
        given = dict(valid.get(name, {}))
        needed = [p.name for p in parameters if p.default is p.empty and p.name not in given]
        names = [p.name for p in parameters]
        if name in PASSED_ON:
            names += list(inspect.signature(PASSED_ON[name]).parameters)
        chosen = rng.sample(names, min(len(names), rng.choice((1, 1, 1, 2, 3))))
        for argument in (*needed, *chosen):
            given[argument] = rng.choice(rng.choice((unusable(), odd(), objects)))
        if name in COMPILING:
            given[rng.choice(COMPILING[name])] = rng.choice(unusable() + odd())
        outcome, detail = make_call(function, given)
        outcomes[outcome] += 1
        if detail:
            kind = f"{name}: {detail}"
            raw.setdefault(kind, describe(given, valid.get(name, {})))
            outcomes[f"raw {name}"] += 1
    return outcomes, raw


def make_call(function: Callable, given: dict[str, object]) -> tuple[str, str]:
    """Return the outcome of a call, "returned", "refused" or "raw", and the text of a raw error."""
    signature = inspect.signature(function)
    args, named = [], dict(given)
    for parameter in signature.parameters.values():
        if parameter.kind is parameter.VAR_POSITIONAL:
            args.extend([named.pop(parameter.name)] if parameter.name in named else [])
        elif parameter.kind is parameter.VAR_KEYWORD:
            extra = named.pop(parameter.name, {})
            named |= extra if isinstance(extra, dict) and all(map(str.isidentifier, extra)) else {}
        elif parameter.kind is parameter.POSITIONAL_ONLY and parameter.name in named:
            args.append(named.pop(parameter.name))
    try:
        signature.bind(*args, **named)
    except TypeError:  # Python itself refuses the call
        return "not callable", ""
    try:
        with limit_time(), warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            result = function(*args, **named)
            del result
        return "returned", ""
    except pj.PlannerJaxError as error:
        line = str(error)
        return ("refused", "") if line and "\n" not in line else ("raw", f"lines {line[:80]!r}")
    except _Late:
        return "raw", f"took over {LONGEST} s"
    except Exception as error:
        if re.search("got (multiple values|an unexpected keyword)", str(error)):  # of Python
            return "not callable", ""
        if isinstance(error, OSError) and "OSError:" in (function.__doc__ or ""):
            return "refused", ""
        frame = inspect.trace()[-1]
        place = f"{Path(frame.filename).name}:{frame.lineno}"
        ours = [f for f in inspect.trace() if "planner_jax" in f.filename]
        inside = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else place
        return "raw", f"{type(error).__name__} at {inside}"


def describe(given: dict[str, object], valid: dict[str, object]) -> str:
    """Format the replaced arguments of a call in one line."""
    new = {k: v for k, v in given.items() if v is not valid.get(k)}
    return ", ".join(f"{k}={' '.join(repr(v).split())[:90]}" for k, v in new.items())


def main() -> None:
    """Print the outcomes of random calls; exit with 1 if one of them raised a raw error."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        outcomes, raw = call_randomly(args.num, args.seed)
    for kind, call in sorted(raw.items()):
        print(f"{kind} | {call}")
    print(dict(outcomes))
    raise SystemExit(1 if raw else 0)


if __name__ == "__main__":
    main()
