"""A table of all searches of a planner of segments, with a row for each stage of each attempt.

An attempt of such a planner is called round, and each stage of a round is one search.

A row has the numbers of a stage. What a program must know when it is compiled, such as the number
of variables, is in the `Model` of a row.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import PyTree

from planner_jax.optimise.chain import ChainPlanner
from planner_jax.optimise.settings import LbfgsConfig, Round, Stage

Number = Array | float | int | bool


@struct.dataclass
class Row:
    """The settings of one search, as Python numbers, or as arrays in a compiled program."""

    solver: tuple[Number, ...]  # the numbers of an `LbfgsConfig`: iterations, tolerance, patience
    weights: dict[str, Number]  # fields of the planner that differ among rows of one model
    model: Number  # () int32, index of the model
    width: Number  # () int32, number of starting points of a case
    keep: Number  # () int32, number of starting points that the next row continues
    first: Number  # () int32, index of the first starting point among the guesses
    within: Number  # (), greatest violation of a case for which the round is made
    is_first: Number  # () bool, in the first round of a planner, which is due for all cases
    starts: Number  # () bool, whether the row is the first one of a round
    ends: Number  # () bool, whether `keep` selects by the status of the plans, not only by cost
    writes: Number  # () bool, whether the plans compete with the best plans of earlier rounds
    frozen: Number  # () bool, whether the variables `ChainPlanner.held` are constant


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A planner and solver whose L-BFGS loop is compiled once."""

    planner: ChainPlanner
    solver: LbfgsConfig
    varying: tuple[str, ...]  # fields of the planner that differ among its rows
    # The indices of the planner's variables among the variables of the finest planner; None if the
    # planner has all of them.
    free: np.ndarray | None


def list_models(
    planner: ChainPlanner, attempts: Sequence[Round], cases: PyTree
) -> dict[Stage, Model] | None:
    """Return the model of each stage of all rounds (attempts), or None without a common table.

    There is none for Newton's method, for searches without iterations, for settings of other fields
    than `weights` and `refinements`, and if the variables of one model are no subset of another's.
    """
    stages = [stage for each in attempts for stage in each.all_stages]
    allowed = {*planner.weights, *planner.refinements}
    if not all(_fits(stage, allowed) for stage in stages):
        return None
    own = {stage: planner.with_settings(stage.settings) for stage in stages}
    groups: dict[tuple, list[Stage]] = {}  # by number of variables and fixed settings of the solver
    for stage in own:
        key = len(own[stage].scale), jax.tree.structure(stage.solver)
        groups.setdefault(key, []).append(stage)
    finest = max(own.values(), key=lambda each: len(each.scale))
    models = {}
    for (size, _), group in groups.items():
        nodes = max(own[stage].nodes for stage in group)
        of_group = own[group[0]].with_settings((("nodes", nodes),))
        names = {name for stage in group for name, _ in stage.settings} & {*planner.weights}
        fields = {name: {getattr(own[stage], name) for stage in group} for name in names}
        varying = tuple(sorted(name for name, values in fields.items() if len(values) > 1))
        free, solver = None, group[0].solver
        assert isinstance(solver, LbfgsConfig)
        if size < len(finest.scale):
            free = None if finest.held is None else np.flatnonzero(~finest.held)
            if free is None or len(free) != size:
                return None
        models |= dict.fromkeys(group, Model(of_group, solver, varying, free))
    lead = len(cases.batch_shape)
    case = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[lead:], x.dtype), cases)
    networks = {each.planner.start_network(case) is None for each in models.values()}
    return models if len(networks) == 1 else None


def _fits(stage: Stage, allowed: set[str]) -> bool:
    is_lbfgs = isinstance(stage.solver, LbfgsConfig) and stage.solver.max_steps > 0
    return is_lbfgs and {name for name, _ in stage.settings} <= allowed


def list_rows(
    planner: ChainPlanner, attempts: Sequence[Round], models: dict[Stage, Model]
) -> list[Row]:
    """Return a row for each stage of all rounds (attempts), and for each choice among starts."""
    pairs = enumerate(attempts)
    return [row for k, each in pairs for row in _rows_of(planner, each, k == 0, models)]


def _rows_of(
    planner: ChainPlanner, attempt: Round, is_first: bool, models: dict[Stage, Model]
) -> list[Row]:
    places = {model: k for k, model in enumerate(dict.fromkeys(models.values()))}
    varying = sorted({name for model in places for name in model.varying})
    width, last, rows = attempt.starts, len(attempt.all_stages) - 1, []
    for k, stage in enumerate(attempt.all_stages):
        fields = planner.with_settings(stage.settings)
        row = Row(
            solver=tuple(jax.tree.leaves(stage.solver)),
            weights={name: getattr(fields, name) for name in varying},
            model=places[models[stage]],
            width=width,
            keep=1 if k == last else min(stage.keep or width, width),
            first=attempt.first,
            within=np.inf if attempt.within is None else attempt.within,
            is_first=is_first,
            starts=k == 0,
            ends=k == last,
            writes=k == last and width == 1,
            frozen=stage.frozen,
        )
        rows.append(row)
        width = row.keep
    if not rows[-1].writes:  # the plan of the best starting point, after 0 iterations
        still = {"solver": (0, *rows[-1].solver[1:]), "width": 1, "starts": False, "writes": True}
        rows.append(dataclasses.replace(rows[-1], **still))
    return rows
