"""The court of paper 002, Section VI-B: regions, targets, 36 scenarios and published rates.

World frame, z up, x towards the opponent, net at x = 0, y to the left. The opponent's half
has x > 0, the hitting half x < 0; the same lines, mirrored in x, divide both.

The paper gives the size of the court; the lines inside it are measured from the published
serves, landing points and targets. The lane line shows itself at 0.84 m: points of the middle
lanes reach 0.8395 m, points of the side lanes begin at 0.8418 m.
"""

import csv
import dataclasses
from importlib import resources

import numpy as np

HALF_LENGTH = 5.0  # [m], net to back line
HALF_WIDTH = 2.5  # [m], middle line to side line
DEAD_ZONE = 0.5  # [m], from the net
NEAR_LINE = 3.0  # [m], from the net; near ends and far begins, in the middle lane
LANE_LINE = 0.84  # [m], from the middle line; middle lane ends and side lane begins

# Near, Far, Left, Right; the published files count them from 1.
REGIONS = "NFLR"

# Left is y > 0 in both halves.
TARGETS = ((1.75, 0.0, 0.0), (4.0, 0.0, 0.0), (3.0, 1.67, 0.0), (3.0, -1.67, 0.0))  # [m]

PLANNERS = ("juggle", "bat-lite", "bat")


def _scenario_names() -> tuple[str, ...]:
    """Serve, landing and target region of the 36 scenarios.

    A case and its mirror image in the middle line count as one, so R stands only behind an L.
    """
    return tuple(
        serve + landing + target
        for serve in "NFL"
        for landing in ("NFLR" if serve == "L" else "NFL")
        for target in ("NFLR" if "L" in (serve, landing) else "NFL")
    )


SCENARIOS = _scenario_names()


@dataclasses.dataclass(frozen=True)
class PublishedRates:
    """Planning success rates in percent: a row per name in SCENARIOS, a column per planner.

    The two sources differ by up to 20 points, so name the one that a number is compared with.
    """

    paper: np.ndarray  # (36, 3) [%], Table I of the paper
    trials: np.ndarray  # (36, 3) [%], counted from the published trial files, 1,000 rows each


def published_rates() -> PublishedRates:
    """The rates that came with paper 002, columns in the order of PLANNERS."""
    text = (resources.files("planner_jax.task.hit") / "published_rates.csv").read_text(
        encoding="utf-8"
    )
    table = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    rows = {row["scenario"]: row for row in table}

    def columns(source: str) -> np.ndarray:
        names = [f"{source}_{planner.replace('-', '_')}" for planner in PLANNERS]
        return np.array([[float(rows[scenario][name]) for name in names] for scenario in SCENARIOS])

    return PublishedRates(paper=columns("paper"), trials=columns("data"))


def region_bounds(depth: float = HALF_LENGTH) -> np.ndarray:
    """Edges of the regions as (4, 2, 2) [m]: region; |x| or y; lower or upper.

    Args:
        depth: [m], where the far and the side regions end.
    """
    near, far = (DEAD_ZONE, NEAR_LINE), (NEAR_LINE, depth)
    whole, middle = (DEAD_ZONE, depth), (-LANE_LINE, LANE_LINE)
    left, right = (LANE_LINE, HALF_WIDTH), (-HALF_WIDTH, -LANE_LINE)
    return np.array([(near, middle), (far, middle), (whole, left), (whole, right)])


def scenario_regions(scenario) -> np.ndarray:
    """Region codes, 1 to 4, of scenarios given by their place in SCENARIOS.

    Args:
        scenario: (...) int.

    Returns:
        (..., 3) int: serve, landing and target region.
    """
    codes = np.array([[1 + REGIONS.index(letter) for letter in name] for name in SCENARIOS])
    return codes[np.asarray(scenario)]


def target_of(scenario) -> np.ndarray:
    """Target points (..., 3) [m] of scenarios given by their place in SCENARIOS."""
    return np.array(TARGETS)[scenario_regions(scenario)[..., 2] - 1]
