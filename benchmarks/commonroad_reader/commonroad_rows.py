"""Plan all problems of a folder of CommonRoad files, and write the plans for `commonroad_judge.py`.

    python benchmarks/commonroad_reader/commonroad_rows.py FOLDER [--out PLANS.json] [--meet given]

The alternative goals of a file are tried in turn, up to the first solved plan. The program prints
for each file the status, the number of tried goals, the speed limit and the verdict of the
library's referee. Of a file that cannot be read it prints the reason, and goes on.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from commonroad_reader import AHEAD, CAR, Problem, read

import planner_jax as pj
from planner_jax.core.errors import PlannerJaxError
from planner_jax.robot.car import CarPlan


def row_of(problem: Problem, plan: CarPlan) -> dict[str, object]:
    """Return a plan's states at the scenario's time steps, for `commonroad_judge.py`.

    A state is x, y of the body's middle [m], heading [rad], speed [m/s], steering angle [rad].
    """
    at = plan.sample(1.0 / problem.step)
    pos = at.pos + AHEAD * np.stack([np.cos(at.heading), np.sin(at.heading)], axis=1)
    steering = np.arctan(CAR["wheelbase"] * at.curvature)
    states = np.column_stack([pos, at.heading, at.speed, steering]).tolist()
    return {"file": problem.file, "problem": problem.number, "states": states}


def plan_first(planner: Any, problems: list[Problem]) -> tuple[int, Problem, Any, Any]:
    """Plan alternative goals in turn; return the number tried, and the last with case and plan."""
    last: Any = None
    for tried, problem in enumerate(problems, 1):
        plan = pj.plan(planner, case := problem.case())
        last = tried, problem, case, plan
        if pj.are_solved(plan):
            break
    return last


def main() -> None:
    """Print a row for every file, and write the plans."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("folder", type=Path, help="folder of XML files")
    parser.add_argument("--out", type=Path, default=Path("plans.json"), help="file for the plans")
    parser.add_argument("--meet", default="given", help="given, early or least")
    options = parser.parse_args()
    files = sorted(options.folder.glob("*.xml"))
    if not files:
        parser.error(f"folder must have XML files, got {options.folder}")
    planner, rows, accepted = pj.intercept.planner(meet=options.meet), [], 0
    for file in files:
        try:
            tried, problem, case, plan = plan_first(planner, read(file))
        except (PlannerJaxError, OSError) as error:
            print(f"{file.stem:26} {'UNREADABLE':12} {error}")
            continue
        verdict = pj.intercept.judge(case, plan)
        rows.append(row_of(problem, plan))
        accepted += bool(verdict.success)
        status, limit = pj.Status(int(plan.status)).name, problem.arguments["speed"]
        print(
            f"{file.stem:26} {status:12} goals {tried}, speed <= {limit:.3g} m/s: "
            f"{verdict.sentence()}"
        )
    options.out.write_text(json.dumps(rows))
    print(f"accepted by the referee: {accepted} of {len(files)}")


if __name__ == "__main__":
    main()
