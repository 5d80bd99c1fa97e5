"""Judge planned trajectories of CommonRoad problems by the checks of the CommonRoad project.

    python benchmarks/commonroad_reader/commonroad_judge.py PLANS.json FOLDER

This program imports nothing of planner-jax. Run it in a virtual environment of its own:

    pip install 'commonroad-io<2026' commonroad-drivability-checker triangle

FOLDER holds the scenarios. PLANS.json is a list of results of `commonroad_rows.row_of`, one for
each plan: the `file` of the scenario, the number `problem` of the planning problem, and
`states`, one for each time step from the initial state on. A state has the position x, y of the
body's middle [m], the heading [rad], the speed [m/s], and the steering angle [rad]. The vehicle is
the kinematic single-track model with the numbers of a BMW 320i.

A plan is valid if every check is passed:

* `start`: the first state agrees with the initial state of the planning problem.
* `goal`: a state lies in the goal region.
* `traffic`: the body touches no obstacle at any time step, where recorded obstacles move as in the
  scenario.
* `road`: the body touches no border of the union of all lanelets, or lies in the union of all
  lanelets enlarged by 1 cm. The second condition accepts bodies on cracks between lanelets. Road
  ends without a successor or predecessor are no borders.
* `vehicle`: inputs exist for which the vehicle model moves from each state to the next, within the
  limits of steering rate, acceleration and friction.
* `official`: `valid_solution`, the check of solutions that are submitted to the CommonRoad website.
  It comprises the other checks, with another representation of the road, in which road ends are
  borders. It needs the package `triangle`, and `valid` does not depend on it.

The number after a failed check is the first time step at which it fails.
"""

import importlib.util
import json
import sys
import warnings
from pathlib import Path
from typing import Any

CHECKS = ("start", "goal", "traffic", "road", "vehicle")
NEEDS = "'commonroad-io<2026' commonroad-drivability-checker triangle"


def judge(folder: Path, plan: dict[str, Any]) -> dict[str, str]:
    """Return the result of each check for one plan: "yes", or "no" with its first time step."""
    load = importlib.import_module
    reader, solution = (load(f"commonroad.common.{name}") for name in ("file_reader", "solution"))
    state, trajectory = (load(f"commonroad.scenario.{name}") for name in ("state", "trajectory"))
    checker = load("commonroad_dc.feasibility.solution_checker")
    array = load("numpy").array
    crcc = load("commonroad_dc.pycrcc")
    scenario, problems = reader.CommonRoadFileReader(str(folder / plan["file"])).open()
    problem = problems.planning_problem_dict[plan["problem"]]
    first = problem.initial_state.time_step
    states = [
        state.KSState(
            time_step=first + k, position=array([x, y]), orientation=angle, velocity=speed,
            steering_angle=steering,
        )
        for k, (x, y, angle, speed, steering) in enumerate(plan["states"])
    ]  # fmt: skip
    motion = trajectory.Trajectory(first, states)
    answer = solution.PlanningProblemSolution(
        plan["problem"], solution.VehicleModel.KS, solution.VehicleType.BMW_320i,
        solution.CostFunction.TR1, motion,
    )  # fmt: skip
    whole = solution.Solution(scenario.scenario_id, [answer])
    vehicle = load("commonroad_dc.feasibility.vehicle_dynamics").VehicleDynamics.KS(
        solution.VehicleType.BMW_320i
    )
    bodies = [
        crcc.RectOBB(vehicle.shape.length / 2, vehicle.shape.width / 2, s.orientation, *s.position)
        for s in states
    ]
    traffic = checker.create_collision_checker(scenario)
    hits = [k for k, b in enumerate(bodies) if traffic.time_slice(first + k).collide(b)]
    border = load("commonroad_dc.boundary.boundary").create_road_boundary_obstacle(scenario)[1]
    lanelets = [each.polygon.vertices for each in scenario.lanelet_network.lanelets]
    shapely = load("shapely")
    road = shapely.union_all(shapely.buffer([shapely.Polygon(ring) for ring in lanelets], 0.01))
    touching = [k for k, body in enumerate(bodies) if border.collide(body)]
    corners = [vehicle.shape.rotate_translate_local(s.position, s.orientation) for s in states]
    leaves = [k for k in touching if not road.covers(shapely.Polygon(corners[k].vertices))]
    is_drivable, inputs = checker.fc.trajectory_feasibility(motion, vehicle, scenario.dt)
    fails = [] if is_drivable else [len(inputs.state_list)]
    found = {
        "start": _passes(checker.starts_at_correct_state, whole, problems),
        "goal": "yes" if problem.goal_reached(motion)[0] else "no",
        "traffic": f"no {hits[0]}" if hits else "yes",
        "road": f"no {leaves[0]}" if leaves else "yes",
        "vehicle": f"no {fails[0]}" if fails else "yes",
    }
    found["valid"] = "yes" if all(found[name] == "yes" for name in CHECKS) else "no"
    found["official"] = _passes(checker.valid_solution, scenario, problems, whole)
    return found


def _passes(check: Any, *arguments: Any) -> str:
    try:
        result = check(*arguments)
    except Exception:  # of any class: a check raises the reason of its failure
        return "no"
    return "yes" if (result[0] if isinstance(result, tuple) else result) else "no"


def main(plans: str, folder: str) -> None:
    """Print one line for each plan, and the number of valid plans."""
    warnings.simplefilter("ignore")
    rows = json.loads(Path(plans).read_text())
    columns = (*CHECKS, "valid", "official")
    print(f"{'file':28} {'problem':>8} " + " ".join(f"{name:>9}" for name in columns))
    num = 0
    for row in rows:
        found = judge(Path(folder), row)
        num += found["valid"] == "yes"
        marks = " ".join(f"{found[name]:>9}" for name in columns)
        print(f"{row['file']:28} {row['problem']:8} {marks}", flush=True)
    print(f"valid: {num} of {len(rows)}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python benchmarks/commonroad_reader/commonroad_judge.py PLANS.json FOLDER")
    if importlib.util.find_spec("commonroad_dc") is None:
        sys.exit(f"install the checks of CommonRoad first: pip install {NEEDS}")
    main(*sys.argv[1:])
