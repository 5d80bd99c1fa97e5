"""Help for compiled loops: `pj.explain`, and errors of functions that work on the host."""

import dataclasses
import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planner_jax as pj
from planner_jax.core.errors import NotOffered

PLANNER, CASES = pj.catch.planner(), pj.catch.draw(2, "throws")
JUGGLER, SERVES = pj.hit.planner("juggle"), pj.hit.draw(3)


def lines(capsys, planner, cases):
    """Return the dotted names that `pj.explain` prints as data, and those it prints as static."""
    pj.explain(planner, cases)
    data, _, static = capsys.readouterr().out.partition("static:")
    return [
        [line.split(":")[0].strip() for line in part.splitlines()[1:]] for part in (data, static)
    ]


def change(args, name, new):
    """Return the dict `args` with a new value at the dotted name."""
    first, _, rest = name.partition(".")
    value = args[first] if isinstance(args, dict) else getattr(args, first)
    value = change(value, rest, new) if rest else new(value)
    new = {first: value}
    return args | new if isinstance(args, dict) else dataclasses.replace(args, **new)


def other(value):
    """Return another value of a setting."""
    if value is None:
        return jnp.zeros(())
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        first = value[:1] or (jnp.zeros(()),)
        return (first[0] + 1, *value[1:]) if isinstance(first[0], float) else value + first
    return value + 1


@pytest.mark.parametrize(
    ("planner", "cases"), [(PLANNER, CASES), (JUGGLER, SERVES)], ids=["catch", "hit"]
)
def test_only_changes_that_explain_calls_static_are_traced_anew(capsys, planner, cases):
    traces, args = [], {"planner": planner, "cases": cases}
    run = jax.jit(lambda planner, cases: traces.append(0) or jax.tree.map(jnp.sum, cases))
    data, static = lines(capsys, planner, cases)
    run(**args)
    for name in data:
        run(**change(args, name, lambda x: x + np.asarray(1, x.dtype)))
    assert len(data) > 12 and len(traces) == 1
    for name in static:
        run(**change(args, name, other))
    assert len(static) > 12 and len(traces) == 1 + len(static)
    for new in (lambda x: x[:, None], lambda x: x.astype(np.float16)):
        run(**change(args, data[0], new))
    assert len(traces) == 3 + len(static)


def test_explain_holds_for_solve(capsys):
    traces, args = [], {"planner": JUGGLER, "cases": SERVES}
    solve = jax.jit(lambda planner, cases: traces.append(0) or pj.solve(planner, cases).status)
    data, static = lines(capsys, **args)
    assert "cases.target" in data and "planner.apex" in static
    for name, new in (("cases.target", lambda x: x + 0.1), ("planner.apex", lambda x: x + 0.1)):
        solve(**args)
        solve(**change(args, name, new))
    assert len(traces) == 2


def test_explain_refuses_cases_of_another_task():
    with pytest.raises(TypeError, match="CatchCase"):
        pj.explain(PLANNER, SERVES)


PLANS = pj.plan(JUGGLER, SERVES)
ON_HOST = {
    "judge": lambda case, plan: pj.hit.judge(case, plan),
    "sample": lambda case, plan: plan.sample(100.0),
    "save": lambda case, plan: plan.save("plan.npz"),
    "sensitivity": lambda case, plan: pj.sensitivity(pj.hit.planner(), case),
    "warm_up": lambda case, plan: pj.warm_up(JUGGLER, case),
}


@pytest.mark.parametrize("name", ON_HOST)
def test_a_function_of_the_host_says_so_inside_a_compiled_function(name):
    with pytest.raises(NotOffered, match=f"^{name} works on the host: .* outside"):
        jax.eval_shape(ON_HOST[name], *jax.tree.map(operator.itemgetter(0), (SERVES, PLANS)))


def test_which_plans_are_solved_is_known_inside_a_compiled_function():
    found = jax.jit(pj.are_solved)(PLANS)
    np.testing.assert_array_equal(found, pj.are_solved(PLANS))
