"""A table of the searches of a planner that minimises: a row for each stage of each attempt.

A row has the numbers of a stage, which a compiled program reads at run time. What a program must
know when it is compiled, such as the number of variables, is in the `Model` of a row. Attempts that
can share a program are one `Group`, whose table `load_group` makes.
"""

import dataclasses
import itertools
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.core import Tracer
from jaxtyping import PyTree

from planner_jax.core.errors import ArgumentError
from planner_jax.core.protocol import BaseAttempt
from planner_jax.lanes import kernels
from planner_jax.optimise.settings import Attempt, LbfgsConfig, Settings, Solver, Stage

if TYPE_CHECKING:
    from planner_jax.optimise.planner import Problem

Number = Array | float | int | bool
_TURNS = 8  # greatest number of iterations on a GPU after which the host asks for unfinished lanes


@struct.dataclass
class Row:
    """The settings of one search, as Python numbers, or as arrays in a compiled program."""

    solver: tuple[Number, ...]  # the numbers of an `LbfgsConfig`: iterations, tolerance, patience
    weights: dict[str, Number]  # values of the problem's fields `weights`
    model: Number  # () int32, index of the model
    width: Number  # () int32, number of starting points of a case
    keep: Number  # () int32, number of starting points that the next row continues
    first: Number  # () int32, index of the first starting point among the guesses
    within: Number  # (), greatest violation of a case for which the attempt is made
    improves: Number  # () bool, whether the attempt is made for solved cases, too
    is_first: Number  # () bool, in the first attempt of a call, which is due for all cases
    is_last: Number  # () bool, whether it returns the plan of the best start, without a search
    starts: Number  # () bool, whether the row is the first one of an attempt
    ends: Number  # () bool, whether `keep` selects by the status of the plans, not only by cost
    writes: Number  # () bool, whether the plans compete with the best plans of earlier attempts
    frozen: Number  # () bool, whether the variables `Problem.held` are constant


@dataclasses.dataclass(frozen=True)
class Model:
    """The constants of a loop that is compiled once for several rows."""

    settings: Settings  # fields of the problem
    solver: Solver  # for L-BFGS, `max_steps` are the turns of `tiles.minimise_tile`
    # Indices of the searched variables among the variables of the finest problem; None: all.
    free: tuple[int, ...] | None


@struct.dataclass
class Table:
    """The rows of a group of attempts as an argument of compiled programs."""

    numbers: Array | np.ndarray  # (R, F), a row for each of R searches
    models: tuple[Model, ...] = struct.field(pytree_node=False)
    finest: Settings = struct.field(pytree_node=False)  # of the problem that decodes all plans
    weights: tuple[str, ...] = struct.field(pytree_node=False)  # the problem's `weights`, sorted
    starts: int = struct.field(pytree_node=False)  # greatest number of starting points of a case
    guesses: int = struct.field(pytree_node=False)  # number of guesses among which rows start
    # Whether a GPU makes as many iterations as the model's solver states. The host then never waits
    # to read whether the loop has ended.
    is_counted: bool = struct.field(pytree_node=False)

    @property
    def is_plain(self) -> bool:
        """Return whether the table is one search from one starting point of each case."""
        return len(self.numbers) == 1 and self.starts == 1

    @property
    def rows(self) -> Row:
        """The R rows: leaves (R,)."""
        flags = {"improves", "is_first", "is_last", "starts", "ends", "writes", "frozen"}
        columns = iter(self.numbers.T)
        solver = tuple(next(columns) for _ in range(3))
        weights = {name: next(columns) for name in self.weights}
        fields: dict[str, PyTree] = {
            "solver": (solver[0].astype(np.int32), solver[1], solver[2].astype(np.int32))
        }
        for name in [field.name for field in dataclasses.fields(Row)][2:]:
            kind = bool if name in flags else np.int32
            column = next(columns)
            fields[name] = column if name == "within" else column.astype(kind)
        return Row(weights=weights, **fields)


@dataclasses.dataclass(frozen=True)
class Group(BaseAttempt):
    """Attempts that share a compiled program, as one attempt."""

    continues: ClassVar[bool] = True  # only plans better than the best plans so far are returned
    attempts: tuple[Attempt, ...] = ()  # all attempts for which the program is compiled
    made: tuple[int, ...] = ()  # indices of the attempts that are made
    is_whole: bool = False  # whether the program has no other attempts
    is_first: bool = True  # whether no attempt has been made before
    place: int = 0  # index of its first attempt among the planner's attempts
    # Arguments of programs in float32 and in float64, after the first use.
    loaded: dict[bool, tuple] = dataclasses.field(default_factory=dict, compare=False, repr=False)

    def place_among(self, attempts: Sequence[BaseAttempt]) -> int:
        """Return the index of its first attempt among a planner's attempts."""
        return self.place

    @classmethod
    def of(
        cls,
        attempts: tuple[Attempt, ...],
        made: tuple[int, ...],
        is_whole: bool = True,
        is_first: bool = True,
        place: int = 0,
    ) -> "Group":
        """Return a group that makes some of these attempts, for the cases that need one of them."""
        own = [attempts[k] for k in made]
        bounds = [np.inf if each.within is None else each.within for each in own]
        return cls(
            starts=max(each.starts for each in own),
            within=None if np.inf in bounds else max(bounds),
            improves=any(each.improves for each in own),
            attempts=attempts,
            made=made,
            is_whole=is_whole,
            is_first=is_first,
            place=place,
        )


# Groups by the identity of their problem, since it takes long to hash a problem.
_RECENT: dict[int, tuple] = {}
_MOST_RECENT = 256


def join_attempts(
    problem: "Problem",
    attempts: tuple[Attempt, ...],
    places: tuple[int, ...],
    is_whole: bool,
) -> list[Group]:
    """Return groups of those attempts whose indices are `places`, in order.

    Unless `is_whole`, each group makes one attempt, though other attempts can share its program.
    The last groups of each problem are stored.
    """
    key, known = (attempts, places, is_whole), _RECENT.get(id(problem))
    if known is not None and known[0] is problem and known[1] == key:
        return known[2]
    groups: list[Group] = []
    for part in _divide(problem, attempts, is_whole):
        own, made = attempts[part.start : part.stop], [k for k in places if k in part]
        together = [made] if is_whole and made else [[k] for k in made]
        for some in together:
            indices = tuple(k - part.start for k in some)
            groups.append(Group.of(own, indices, is_whole, not groups, some[0]))
    if len(_RECENT) >= _MOST_RECENT:
        _RECENT.clear()
    _RECENT[id(problem)] = problem, key, groups
    return groups


def _divide(problem: "Problem", attempts: tuple[Attempt, ...], is_whole: bool) -> list[range]:
    """Return the indices of consecutive attempts that one compiled program can make.

    These attempts have equal values of all fields of the problem that `weights` and `refinements`
    do not list. Unless `is_whole`, they also have the same models. The first attempts of one stage
    and one starting point are then apart, because their program is compiled fast.
    """
    names = {name for each in attempts for stage in each.all_stages for name, _ in stage.settings}
    fixed = sorted(names - {*problem.weights, *problem.refinements})
    keys: list[Hashable] = []
    leads = True
    for each in attempts:
        own, is_plain = problem.with_settings(each.settings), each.starts == 1 and not each.stages
        shared = tuple(own.setting(name) for name in fixed)
        models = frozenset(_key_of_model(problem, stage) for stage in each.all_stages)
        leads = leads and is_plain and (not keys or keys[0] == (shared, models, True))
        keys.append(shared if is_whole else (shared, models, leads))
    groups: list[range] = []
    for k in range(len(attempts)):
        if groups and keys[groups[-1].start] == keys[k]:
            groups[-1] = range(groups[-1].start, k + 1)
        else:
            groups.append(range(k, k + 1))
    return groups


def _key_of_model(problem: "Problem", stage: Stage) -> tuple:
    ignored = {*problem.weights} | {*problem.refinements} & {"nodes"}
    names = {name for name, _ in stage.settings} - ignored
    own, solver = problem.with_settings(stage.settings), stage.solver
    is_counted = isinstance(solver, LbfgsConfig) and solver.max_steps > 0
    fixed = jax.tree.structure(solver) if is_counted else solver
    return own.size, fixed, tuple((name, own.setting(name)) for name in sorted(names))


def load_group(problem: "Problem", group: Group) -> tuple[PyTree, Table]:
    """Return a planner and a table, in a jax array, as arguments of programs for a group.

    The table has the numbers of the attempts and of the problem's `weights`. The returned planner
    has their defaults, so that problems with other numbers share programs.
    """
    is_double = bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]
    if is_double not in group.loaded:
        table = _make_table(problem, group)
        with jax.ensure_compile_time_eval():
            table = dataclasses.replace(table, numbers=jnp.asarray(table.numbers))
        from planner_jax.optimise.planner import SearchPlanner  # imports this module

        group.loaded[is_double] = SearchPlanner(problem.with_usual(table.weights)), table
    return group.loaded[is_double]


def _make_table(problem: "Problem", group: Group) -> Table:
    stages = list(dict.fromkeys(s for each in group.attempts for s in each.all_stages))
    own = {name: problem.setting(name) for name in sorted(problem.weights)}
    weights = [n for n, x in own.items() if np.ndim(x) == 0 and not isinstance(x, Tracer)]
    models = list_models(problem, stages, weights, group.is_whole)
    lists = [_rows_of(problem, each, models, weights) for each in group.attempts]
    rows = list(itertools.chain(*(lists[k] for k in group.made)))
    every = list(itertools.chain(*lists))
    for k in range(len(lists[group.made[0]]) if group.is_first else 0):
        rows[k] = dataclasses.replace(rows[k], is_first=True)
    if not group.is_whole:  # rows that are never made fill the table
        most = max(map(len, lists))
        unmade = dataclasses.replace(lists[0][0], within=-np.inf, improves=False)
        rows += [unmade] * (most - len(rows))
    lasts = [each.all_stages[-1] for each in group.attempts]
    finest = max(lasts, key=lambda stage: problem.with_settings(stage.settings).size).settings
    finest = tuple(pair for pair in finest if pair[0] not in weights)
    numbers = np.array([[float(x) for x in jax.tree.leaves(row)] for row in rows])
    is_gpu, turns = kernels.has_gpu(), models[lasts[0]].solver.max_steps
    return Table(
        numbers=numbers,
        models=tuple(dict.fromkeys(models.values())),
        finest=finest,
        weights=tuple(weights),
        starts=max(int(row.width) for row in every),
        guesses=max(int(row.first) + int(row.width) for row in every if row.starts),
        is_counted=bool(is_gpu and len(rows) == 1 and rows[0].solver[0] <= turns),
    )


def list_models(
    problem: "Problem", stages: Sequence[Stage], weights: Sequence[str], is_whole: bool
) -> dict[Stage, Model]:
    """Return the model of each stage; stages with equal constants share a model.

    With `is_whole`, stages that differ in their number of nodes share the model with most nodes: it
    compiles faster, and searches more slowly.

    Raises:
        ArgumentError: a stage has fewer variables than the finest problem, and they are not the
            variables that remain when this problem's `held` variables are constant.
    """
    own = {stage: problem.with_settings(stage.settings) for stage in stages}
    apart = not is_whole and "nodes" in problem.refinements
    groups: dict[tuple, list[Stage]] = {}
    for stage in stages:
        key = _key_of_model(problem, stage), apart and own[stage].setting("nodes")
        groups.setdefault(key, []).append(stage)
    finest = max(own.values(), key=lambda each: each.size)
    models: dict[Stage, Model] = {}
    for group in groups.values():
        names = {name for stage in group for name, _ in stage.settings}
        first, free = own[group[0]], None
        settings = {name: first.setting(name) for name in sorted(names - {*weights})}
        if "nodes" in {*settings} & {*problem.refinements}:
            settings["nodes"] = max(own[stage].setting("nodes") for stage in group)
        if first.size < finest.size:
            held = finest.held
            free = () if held is None else tuple(np.flatnonzero(~held).tolist())
            if len(free) != first.size:
                rule = "of stages that search all variables, or all that are not `held`"
                raise ArgumentError("attempts", rule, shown="")
        pairs, solver = tuple(settings.items()), group[0].solver
        if isinstance(solver, LbfgsConfig):  # the rows have the numbers
            most = min(_TURNS, *(stage.solver.max_steps for stage in group))
            solver = dataclasses.replace(solver, max_steps=most, tolerance=0.0, patience=0)
        model = Model(pairs, solver, free)
        models |= dict.fromkeys(group, model)
    return models


def _rows_of(
    problem: "Problem", attempt: Attempt, models: dict[Stage, Model], weights: list[str]
) -> list[Row]:
    places = {model: k for k, model in enumerate(dict.fromkeys(models.values()))}
    width, last, rows = attempt.starts, len(attempt.all_stages) - 1, []
    for k, stage in enumerate(attempt.all_stages):
        fields, solver = problem.with_settings(stage.settings), stage.solver
        is_lbfgs = isinstance(solver, LbfgsConfig)
        row = Row(
            solver=tuple(jax.tree.leaves(solver)) if is_lbfgs else (1, 0.0, 0),
            weights={name: fields.setting(name) for name in weights},
            model=places[models[stage]],
            width=width,
            keep=1 if k == last else min(stage.keep or width, width),
            first=attempt.first,
            within=np.inf if attempt.within is None else attempt.within,
            improves=attempt.improves,
            is_first=False,
            is_last=False,
            starts=k == 0,
            ends=k == last,
            writes=k == last and width == 1,
            frozen=stage.frozen,
        )
        rows.append(row)
        width = row.keep
    if not rows[-1].writes:
        end = {"width": 1, "starts": False, "writes": True, "is_last": True}
        rows.append(dataclasses.replace(rows[-1], **end))
    return rows
