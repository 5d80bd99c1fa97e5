"""Attempts of `spacetime` at an interception: how many ways, and how many steps from each."""

import dataclasses

from planner_jax.core.protocol import Attempt
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane import reach

# A way takes about as much memory as so many starts of planners with few unknowns.
_ROOM = 8
_ROOM_OF_WORD = 1 / 32768  # the same of a word of a reach set


@dataclasses.dataclass(frozen=True)
class Search(Attempt):
    """An attempt: so many ways, and so many steps from each; static."""

    starts: int = dataclasses.field(init=False, default=1)
    ways: int = 16
    solver: LevenbergConfig = LevenbergConfig()  # of the stage that keeps limits
    following: int = 4  # steps along the way of cells
    settling: int = 16  # steps towards less effort, or an earlier meeting
    margin: float = 0.03  # [m], kept from obstacles
    slack: float = 0.015  # share of every limit that is kept free
    discs: int = 3  # that the body counts as in least squares
    seed: int = 0  # of the ways
    drawn: int = 4  # ways for each that is tried: the smoothest of them
    directness: float = 2.0  # of these ways; see `reach.draw_way`
    lattice: reach.Lattice = reach.Lattice()
    girth: float = 1.0  # of the body in the reach set; less finds ways that rounding closes

    def __post_init__(self) -> None:
        if self.ways < 1:
            raise ValueError(f"ways must be >= 1, got {self.ways}")
        lattice = self.lattice
        words = lattice.cells**2 // 32 * lattice.levels * lattice.headings * lattice.layers
        starts = max(_ROOM * self.ways, round(_ROOM_OF_WORD * words))
        object.__setattr__(self, "starts", starts)


_GIVEN = (
    Search(2, LevenbergConfig(10), following=3),
    Search(4, LevenbergConfig(16), seed=1, girth=0.9),
    Search(16, LevenbergConfig(24), seed=2, girth=0.75, drawn=1, directness=0.0),
)
QUICK = tuple(
    dataclasses.replace(search, ways=ways, solver=LevenbergConfig(steps), settling=12)
    for search, ways, steps in zip(_GIVEN, (2, 4, 6), (8, 10, 14), strict=True)
)
# A car that begins beside a wall has no room for margins: many ways, which keep next to none.
_NARROW = tuple(
    Search(64, LevenbergConfig(60), seed=seed, girth=girth, margin=0.006, slack=1e-3, discs=7)
    for seed, girth in ((3, 0.9), (4, 0.75), (6, 0.9))
)
BEST = (dataclasses.replace(_GIVEN[0], ways=8, settling=48), *_GIVEN[1:], *_NARROW)
# Of a free time every way is tried, until it brings little, and the best one is kept. To hurry is
# to leave the cells: early meetings come out earlier where nothing follows them.
_EARLY = Search(
    32,
    LevenbergConfig(60, tolerance=5e-4),
    following=0,
    girth=0.85,
    drawn=1,
    directness=0.0,
)
_LEAST = Search(16, LevenbergConfig(60, tolerance=5e-4))
_LATER = (
    Search(8, seed=1, girth=0.9),
    dataclasses.replace(_GIVEN[2], solver=LevenbergConfig(30)),
)
SEARCHES = {
    "given": _GIVEN,
    "early": (_EARLY, *_LATER),
    "least": (_LEAST, *_LATER),
}
