"""Bad calls of the library, a line each, that it has to refuse in one line.

A row is a call, written as a user writes it, and the beginning of the message that refuses it. The
names that stand for what is given, such as `hits`, are those of `test_bad_calls.py`.
"""


def _of(call: str, argument: str, *values: str, words: str = "") -> list[tuple[str, str]]:
    """Rows of one argument, with whose name the message begins.

    Args:
        call: with "@" where `argument=value` is put.
        argument: its name; with ".name" in front of values that are positional.
        *values: as they are written.
        words: with which the message begins instead.
    """
    begins = words or f"{argument} must "
    return [(call.replace("@", f"{argument}={value}"), begins) for value in values]


def _cases() -> list[tuple[str, str]]:
    rows = []
    hit = "pj.hit.case(**{**HIT, **dict(@)})"
    for name in ("serve_pos", "serve_vel", "target"):
        rows += _of(hit, name, "'abc'", "None", "5.0", "[]", "(1, 2)", "((1, 2), (3, 4))")
        rows += _of(hit, name, "(1j, 0, 1)", "['1', '2', '3']", "object()", "{}", "((1, 2), (3,))")
    rows += _of(hit, "serve_pos", "(nan, 0, 1)", words="serve_pos must be finite, got nan")
    rows += _of(hit, "serve_vel", "(0, inf, 1)", words="serve_vel must be finite, got inf")
    rows += _of(hit, "target", "(0, 0, -inf)", "(1e60, 0, 0)", words="target must be finite, got")
    rows += _of(hit, "start", "'uniform'", "None", "(1, 2)", "1.0", "np.zeros((2, 3))")
    rows += _of(hit, "start", "(nan, 0, 1)", "(0, 0, 0.2)")
    numbers = ("'x'", "(1, 2)", "1j", "[[1.0]]", "b'1'", "object()")
    for name in ("drag", "gravity", "restitution", "racket_height"):
        rows += _of(hit, name, *numbers, "nan")
    rows += _of(hit, "drag", "None") + _of(hit, "gravity", "None")
    for name in ("min_apex", "max_apex"):
        rows += _of(hit, name, *numbers, "None")
        rows += _of(hit, name, "nan", words=f"{name} must be finite, got nan")
    for name in ("speed", "acceleration", "body_rate", "min_height"):
        rows += _of(hit, name, *numbers)
        rows += _of(hit, name, "-1", "nan", "inf")
    rows += _of(hit, "drag", "-1e-9", "inf") + _of(hit, "gravity", "0", "-9.8")
    rows += _of(hit, "restitution", "1.01", "-0.1")
    rows += _of(hit, "hitting_speed", "4.0", "(4, 3)", "None")
    rows += _of(hit, "hitting_speed", "(4, 0, 4)", words="hitting_speed must be > 0")
    rows += _of(hit, "min_apex", "7.0", words="min_apex must be < max_apex")
    rows += _of(hit, "extras", "None", "5", "(5,)", "('x',)", "(pj.KeepOut,)")
    rows += _of(hit, "extras", "pj.KeepOut((0, 0, 1), 1.0)")
    rows += _of(
        hit,
        "extras",
        "(pj.KeepOut((0, 0), 1.0),)",
        words="extras.0 must be for one case, got a KeepOut with centre (2,), radius ()",
    )
    rows += _of(
        hit, "extras", "(pj.KeepOut((0, 0, 1), -1.0),)", words="extras.0.radius must be > 0"
    )
    rows += _of(
        hit, "extras", "(pj.KeepOut((nan, 0, 1), 1.0),)", words="extras.0.centre must be finite"
    )
    rows += _of(hit, "dtype", "int", "'float33'", "complex", "np.float64", "None", "5", "'x'")
    several = "pj.hit.case(**{**HITS, **dict(@)})"
    rows += _of(several, "serve_vel", "np.zeros((3, 3))", "np.zeros((2, 2))", "np.zeros((1, 3))")
    rows += _of(several, "drag", "(0.1, 0.1, 0.1)", "[[0.1], [0.1]]", "[0.1]")
    rows += _of(several, "hitting_speed", "np.ones((3, 2))", "(1, 1)")

    catch = "pj.catch.case(**{**CATCH, **dict(@)})"
    rows += _of(catch, "horizon", "3.0", "'x'", "None", "(1j, 1)", "[]", "('1', '2')")
    rows += _of(catch, "horizon", "(nan, 1)", "(0, 1)", "(1, -1)", "(1, inf)")
    rows += _of(catch, "horizon", "(1, 1, 1)", words="targets must have leaves that begin with")
    rows += _of(catch, "targets", "None", "5", "'x'", "HIT", "ball_path(3)", "pj.hit", "()")
    rows += _of(catch, "targets", "turning(2)", "hits.ball", "pj.lane(ball_path(2), 0)")
    rows += _of(catch, "targets", "pj.BallPath", "lambda t: t", "[ball_path(2)]")
    rows += _of(
        catch,
        "targets",
        "having(ball_path(2), 'drag', np.zeros(2))",
        words="targets.drag must have the shape (2, 3), got (2,)",
    )
    rows += _of(
        catch,
        "targets",
        "having(ball_path(2), 'ball.pos', np.zeros((2, 2)))",
        words="targets must be a path of which at(time) gives a position, with the axes (2,) of ",
    )
    rows += _of(catch, "start", "(0, 0, 0.2)")
    rows += _of(catch, "present", "(True,)", "'x'", "None", "(0.5, 1.0)", "(2, 1)", "('a', 'b')")
    rows += _of(catch, "gravity", "None")
    for name in ("gravity", "net_height", "net_radius", "max_angle", "speed", "body_rate"):
        rows += _of(catch, name, "'x'", "(1, 2)", "1j", "[[1.0]]")
    rows += _of(catch, "min_thrust", "'x'", "(1, 2)", "1j")
    rows += _of(catch, "gravity", "0", "nan")
    rows += _of(catch, "net_radius", "0", "nan")
    rows += _of(catch, "max_angle", "4", "-1", words="max_angle must be in [0, pi]")
    rows += _of(catch, "min_thrust", "30.0", words="min_thrust must be < max_thrust")
    rows += _of(catch, "optional", "'yes'", "None", "1.0", "np.array([True, False])")
    rows += _of(catch, "extras", "None", "(5,)") + _of(catch, "start", "(0, 0)", "'x'")
    rows += _of(catch, "dtype", "int", "np.float64")

    intercept = "pj.intercept.case(**{**INTERCEPT, **dict(@)})"
    rows += _of(intercept, "target", "None", "5", "'x'", "(1, 2)", "pj.TurningPath", "turning(2)")
    rows += _of(intercept, "target", "ball_path(1)", "pj.lane(ball_path(1), 0)")
    rows += _of(intercept, "time", "0", "-1", "nan", "inf", "'x'", "None", "1j")
    rows += _of(intercept, "time", "(5.0, 5.0)", words="target must have leaves that begin with")
    rows += _of(intercept, "start", "(1, 2)", "'x'", "None", "(nan, 0, 0)", "5")
    rows += _of(intercept, "initial_speed", "'x'", "None", "1j")
    rows += _of(intercept, "initial_speed", "-1", "nan")
    rows += _of(intercept, "initial_curvature", "nan")
    rows += _of(intercept, "tolerance", "0", "nan", "'x'")
    for name in ("walls", "movers"):
        wrong = ("None", "5", "'x'", "[5]", "[[(0, 0), (1, 1)]]", "['x']", "[[(0, 0), (1,)]]")
        wrong += ("[np.zeros((4, 2))]", "[np.full((3, 2), nan)]", "[SQUARE[[0, 2, 1, 3]]]")
        rows += _of(intercept, name, *wrong)
    rows += _of(intercept, "walls", "two_walls", words="walls.centre must have the shape")
    rows += _of(intercept, "mover_velocities", "'x'", "None", "(1, 2, 3)", "(nan, 0)")
    rows += _of(intercept, "lower", "(9, 9)", "(0, 0, 0)", "'x'", "None", "1.0")
    rows += _of(intercept, "upper", "(nan, 8)", "8.0")
    rows += _of(intercept, "length", "0")
    rows += _of(intercept, "curvature", "0")
    rows += _of(intercept, "heading_tolerance", "'x'", "(1, 2)")
    rows += _of(intercept, "dtype", "int", "np.float64")

    group = "pj.group.case(**{**dict(targets=turning(3)), **dict(@)})"
    rows += _of(group, "targets", "None", "5", "'x'", "pj.lane(turning(1), 0)")
    rows += _of(group, "targets", "ball_path(3)", words="target must give positions of the shape")
    rows += _of(group, "present", "(True,)", "'x'", "None", "(1, 0, 1)", "0.5")
    rows += _of(group, "time", "0", "nan", "'x'")

    block = "pj.block.case(**{**BLOCK, **dict(@)})"
    for name in ("ball_pos", "ball_vel"):
        rows += _of(block, name, "'abc'", "None", "5.0", "(1, 2)", "(1j, 0, 1)", "[]")
    rows += _of(block, "ball_pos", "(nan, 0, 1)")
    rows += _of(block, "delay", "-1", "nan", "'x'", "None", "1j")
    rows += _of(block, "regime", "'R9'", "None", "5", "['R1']")
    rows += _of(block, "wide", "'no'", "None", "5", "np.array([True, False])")
    rows += _of(block, "anywhere", "'no'", "None", "5")
    rows += _of(block, "scene", "5", "'x'", "HIT") + _of(block, "arm", "5", "'irb1600'")
    rows += _of(block, "angles", "(0, 0)", "0.0", "'x'", "(nan, 0, 0, 0, 0, 0)")
    rows += _of(block, "rates", "(0, 0)", "'x'", "None", "nan")
    rows += _of(block, "gravity", "0", "nan", "'x'", "None")
    rows += _of(block, "dtype", "int", "np.float64")
    return rows


def _draws() -> list[tuple[str, str]]:
    rows = []
    for task in ("hit", "catch", "intercept", "block"):
        draw = f"pj.{task}.draw(@)"
        wrong = ("0", "-1", "1.5", "'10'", "None", "True", "2**70", "10**15", "nan", "(2,)", "1j")
        rows += _of(draw, "num", *wrong)
        more = f"pj.{task}.draw(2, @)"
        rows += _of(more, "seed", "-1", "1.5", "'0'", "None", "2**70", "True", "(1, 2)")
        rows += _of(more, "first", "-1", "1.5", "'0'", "None", "2**70")
        rows += _of(more, "suite", "'nowhere'", "5", "('court',)", "['a']", "b'x'", "True")
        rows += _of(more, "dtype", "int", "'float33'", "complex", "np.float64")
    hit = "pj.hit.draw(2, @)"
    rows += _of(hit, "start", "(1, 2)", "(nan, 0, 1)", "'anywhere'", "None", "5", "(0, 0, '1')")
    rows += _of(hit, "delay", "-1", "nan", "inf", "'x'", "None", "(0.1, 0.1)", "9.0")
    rows += _of(hit, "limit_scale", "0", "-1", "nan", "inf", "'x'", "None", "1e9", "(1, 1)")
    rows += _of("pj.catch.draw(2, @)", "limit_scale", "0", "-1", "nan", "'x'", "None", "1e9")
    block = "pj.block.draw(2, @)"
    rows += _of(block, "regime", "'R9'", "None", "5") + _of(block, "delay", "-1", "nan", "'x'")
    rows += _of(block, "wide", "'no'", "5", "None")
    return rows


def _planners() -> list[tuple[str, str]]:
    rows = []
    for task, name in (("hit", "exact"), ("catch", "exact"), ("intercept", "spacetime")):
        made = f"pj.{task}.planner(@)"
        wrong = ("'nobody'", "5", "None", "''", "'é'", "['exact']", "b'exact'")
        rows += _of(made, "name", *wrong, words="planner must be ")
        rows += [(f"pj.{task}.planner('{name}:file')", "planner ")]
    wrong = ("'nobody'", "5", "None", "'library'", "'library:'")
    rows += _of("pj.block.planner(@)", "name", *wrong, words="planner must ")
    for kind in ("library", "adapt"):
        rows.append((f"pj.block.planner('{kind}:gone')", "library must be"))
    for task in ("hit", "catch"):
        made = f"pj.{task}.planner(@)"
        rounds = ("()", "[]", "(1,)", "None", "5", "'x'", "pj.Round()", "(pj.LbfgsConfig(),)")
        rows += _of(made, "rounds", *rounds)
        rows += _of(made, "nodes", "0", "-1", "1.5", "'4'", "None", "nan", "True", "(4,)")
        rows += _of(made, "margin", "nan", "inf", "'x'", "None", "(1, 2)", "1j")
        rows += _of(made, "energy_weight", "nan", "'x'", "-1")
        rows += _of(made, "hinge_width", "-1")
        rows += _of(made, "proportions", "()", "(1.0,)", "(1.0, nan)", "(1.0, 0.0)", "5", "'ab'")
        rows += _of(made, "proportions", "None", "(1.0, 'x')")
        rows += _of(made, "scale", "(1.0,)", "'x'", "(nan,)", "5")
    rows += _of("pj.hit.planner(@)", "num_table_nodes", "0", "1", "4")
    rows += _of("pj.hit.planner(@)", "drag_after_impact", "'no'", "None", "5")
    rows += _of("pj.catch.planner(@)", "lift", "nan", "'x'")
    decide = ("'nobody'", "5", "None", "''", "'policy:'", "list", "['best']")
    rows += _of("pj.catch.planner(@)", "decide", *decide)
    rows += [("pj.catch.planner(decide='best:file')", "decide must be best without a file")]
    rows += [("pj.catch.planner(decide='policy:gone')", "checkpoint must be")]
    rows += _of("pj.group.planner(@)", "decide", "'nobody'", "5", "None")
    rows += _of("Best(@)", "finalists", "0", "-1", "1.5", "'6'", "None", "inf")
    rows += _of("Best(@)", "width", "0", "nan") + _of("Best(finalists=9, @)", "width", "8")
    spacetime = "pj.intercept.planner(@)"
    rows += _of(spacetime, "meet", "'late'", "None", "5", "()", "['early']")
    rows += _of(spacetime, "pieces", "0", "-1", "1.5", "'32'", "None")
    rows += _of(spacetime, "searches", "()", "(1,)", "5", "[]", "pj.Round()", "(pj.Round(),)")
    rows += _of(spacetime, "tries_all", "'no'", "5")
    online = "pj.block.planner(@)"
    rows += _of(online, "pieces", "0", "1.5", "'x'") + _of(online, "points", "0", "None")
    rows += _of(online, "margin", "nan", "'x'", "None") + _of(online, "slack", "nan")
    rows += _of(online, "searches", "()", "(1,)", "5", "None") + _of(online, "brisk", "'no'", "5")
    rows += _of(online, "weights", "None", "5", "()")

    rows += _of("pj.Round(@)", "starts", "0", "-1", "1.5", "'1'", "None", "nan", "True")
    rows += _of("pj.Round(@)", "solver", "None", "5", "'x'", "()", "pj.Round()")
    rows += _of("pj.LbfgsConfig(@)", "max_steps", "-1", "1.5", "'x'", "None", "inf", "True")
    rows += _of("pj.LbfgsConfig(@)", "memory", "0", "1.5", "None")
    rows += _of("pj.LbfgsConfig(@)", "trial_steps", "()", "5", "None", "(nan,)", "('x',)", "(0.0,)")
    rows += _of("pj.LbfgsConfig(@)", "step_cap", "-1", "nan", "inf", "'x'", "None")
    rows += _of("pj.LbfgsConfig(@)", "tolerance", "-1", "nan", "'x'", "None", "(1, 2)")
    rows += _of("pj.LbfgsConfig(@)", "patience", "-1", "1.5")

    policy = "policy(@)"
    rows += _of(policy, "stretch", "-1", "0", "nan", "inf", "'x'", "None", "(1, 2)", "1j", "True")
    rows += _of(policy, "spread", "-1", "nan", "inf", "'x'", "None", "[1.0]")
    rows += _of(policy, "proposals", "0", "-1", "1.5", "'3'", "None", "True", "nan")
    rows += _of(policy, "file", "5", "None", "''", "'gone'", "'.'", words="checkpoint must be")
    rows += [("Policy(None, None, stretch=-1)", "stretch must be finite and > 0, got -1")]
    rows += [("Policy(params=None, network=None)", "network must be")]
    rows += [("dataclasses.replace(policy(), proposals=0)", "proposals must be >= 1, got 0")]
    return rows


def _plans() -> list[tuple[str, str]]:
    rows = _of("pj.table_path(**{**TABLE, **dict(@)})", "times", "'x'", "(0, 1, 1)", "((0, 1),)")
    rows += _of("pj.table_path(**{**TABLE, **dict(@)})", "positions", "'x'", "np.zeros((3, 2))")
    rows += _of("pj.table_path(**{**TABLE, **dict(@)})", "nodes", "'x'", "5.5", "4")
    rows += _of("pj.table_path(**{**TABLE, **dict(@)})", "error", "'x'", "0", "nan")
    rows += _of("pj.table_path(**{**TABLE, **dict(@)})", "dtype", "int", "np.float64")
    rows += [("pj.hit.planner(round=3)", "option of planner exact must be one of ")]
    for call in ("plan", "solve"):
        for planner in ("None", "5", "'exact'", "pj.hit", "pj.hit.planner", "hits", "type(exact)"):
            rows.append((f"pj.{call}({planner}, hits)", "planner must be one, such as"))
        for cases in ("None", "5", "'hits'", "catches", "blocks", "drives", "[hit]", "hit_plans"):
            rows.append((f"pj.{call}(exact, {cases})", "ExactHit plans cases of the class HitCase"))
        rows.append((f"pj.{call}(catcher, hits)", "DecidedPlanner plans cases of the class Catch"))
        rows.append((f"pj.{call}(driver, blocks)", "SpacetimeIntercept plans cases of the class"))
        rows.append((f"pj.{call}(blocker, drives)", "OnlineBlock plans cases of the class"))
        whole = f"pj.{call}(exact, having(hits, '@', np.zeros"
        rows += [
            (
                whole.replace("@", "drag") + "(3, np.float32)))",
                "drag must have the shape (2,), got (3,)",
            ),
            (
                f"pj.{call}(exact, having(hits, 'drag', 0.1))",
                "drag must have the shape (2,), got ()",
            ),
            (whole.replace("@", "head_state") + "((2, 3, 4), np.float32)))", "head_state must"),
            (whole.replace("@", "gravity") + "((2, 1), np.float32)))", "gravity must have the"),
            (
                whole.replace("@", "target") + "((1, 3), np.float32)))",
                "target must have the shape (2, 3)",
            ),
        ]
        rows += [
            (f"pj.{call}(exact, having(hits, 'target', {value}))", "target must")
            for value in ("np.zeros((2, 2), np.float32)", "np.zeros((2, 3), int)", "None")
            + ("np.zeros((2, 3), np.complex64)", "np.full((2, 3), 'x')", "np.full((2, 3), None)")
            + ("np.zeros((2, 3), bool)",)
        ]
    for name, value, rule in (
        ("target", "nan", "finite, got nan"),
        ("drag", "-1.0", ">= 0, got -1"),
        ("gravity", "inf", "finite, got inf"),
        ("restitution", "2.0", "in [0, 1], got 2"),
        ("limits.speed", "0.0", "> 0, got 0"),
        ("hit_limits.min_apex", "9.0", "< hit_limits.max_apex, got 9"),
    ):
        rows.append((f"pj.plan(exact, filled(hits, '{name}', {value}))", f"{name} must be {rule}"))
        rows.append((f"pj.require_sound(filled(hit, '{name}', {value}))", f"{name} must be {rule}"))
    rows += [
        ("pj.plan(catcher, filled(catches, 'order', 1))", "order must be a permutation"),
        ("pj.plan(catcher, filled(catches, 'horizon', -1.0))", "horizon must be > 0"),
        ("pj.plan(catcher, having(catches, 'targets', None))", "targets must be given, got None"),
        ("pj.plan(driver, filled(drives, 'time', 0.0))", "time must be > 0"),
        ("pj.plan(driver, having(drives, 'target', None))", "target must"),
        ("pj.plan(blocker, filled(blocks, 'tilt', 4.0))", "tilt must be in [0, pi]"),
        ("pj.plan(exact, pj.lane(hits, slice(0, 0)))", "cases must be a batch of at least one"),
        ("pj.plan(exact, jax.tree.map(lambda x: x[None], hits))", "cases must be a batch"),
        ("pj.plan(exact, having(hits, 'extras', (5,)))", "cases.extras[0] must have 2 lanes"),
        ("pj.plan(exact, jax.tree.map(np.float64, hits))", "cases must be in float32"),
        ("pj.plan(exact, jax.tree.map(np.float16, hits))", "ball.pos must be in float32 or"),
        ("pj.solve(exact, jax.tree.map(np.float16, hits))", "ball.pos must be in float32 or"),
    ]
    plan = "pj.plan(exact, hits, @)"
    rows += _of(plan, "chunk", "0", "-1", "1.5", "'2'", "True", "nan", "(1,)", "1j")
    rows += _of(plan, "devices", "()", "[]", "5", "'cpu'", "[0]", "['cpu:0']", "[None]")
    rows += _of(plan, "devices", "jax.devices() * 2", "jax.devices()[0]", "set(jax.devices())")
    return rows


def _replans() -> list[tuple[str, str]]:
    again = "pj.replan(exact, hits, hit_plans, 0.1, ball=hits.ball)"
    rows = [
        (again.replace("0.1", value), "elapsed must")
        for value in ("-0.1", "nan", "inf", "'x'", "None", "(0.1,) * 3", "1j", "[[0.1, 0.1]]")
    ]
    rows += [
        (again.replace("hit_plans", value), "previous must")
        for value in ("None", "5", "hits", "catch_plans", "lane0(hit_plans)", "hit_plans.stroke")
    ]
    rows += [
        (again.replace("hit_plans", f"first({num}, hit_plans)"), "previous must") for num in (1, 3)
    ]
    rows += [
        (again.replace("hits,", value), "cases must")
        for value in ("None,", "5,", "catches,", "hit_plans,")
    ]
    rows += [
        (again.replace("exact", value), "planner must be one, such as")
        for value in ("None", "5", "'exact'", "pj.hit", "type(exact)")
    ]
    rows.append((again.replace("exact", "pj.hit.planner('juggle')"), "JuggleHit cannot plan again"))
    rows.append((again.replace("exact", "driver"), "cases must be a InterceptCase, got a HitCase"))
    rows += [
        (again.replace("hits.ball", value), "ball must")
        for value in ("None", "5", "'x'", "hit.ball", "hits", "ball_path(2)", "hits.ball.pos")
    ]
    rows += [
        (again.replace(")", ", head_state=np.zeros((3, 4)))"), "head_state must"),
        (again.replace(")", ", head_state='x')"), "head_state must"),
        (again.replace(")", ", head_state=np.full((2, 4, 3), nan))"), "head_state must be finite"),
        (again.replace(")", ", head_state=np.zeros(3))"), "head_state must"),
        (again.replace(")", ", drag='x')"), "drag must"),
        (again.replace(")", ", drag=-1.0)"), "case.drag must be >= 0, got -1"),
        (again.replace(")", ", drag=np.ones(3))"), "drag must"),
    ]
    of_catch = "pj.replan(catcher, catches, catch_plans, 0.1, targets=catches.targets)"
    rows += [
        (of_catch.replace("catches.targets", value), "targets must")
        for value in ("None", "5", "lane0(catches.targets)", "hits.ball", "catches")
    ]
    rows += [
        (of_catch.replace("catch_plans", value), "previous must")
        for value in ("None", "hit_plans", "lane0(catch_plans)")
    ]
    rows.append((of_catch.replace("0.1", "-1"), "elapsed must be >= 0, got -1"))
    of_drive = "pj.replan(driver, drives, drive_plans, 0.1, target=drives.target)"
    rows += [
        (of_drive.replace("drives.target", value), "target must")
        for value in ("None", "5", "hits", "lane0(drives.target)")
    ]
    rows += [
        (of_drive[:-1] + f", {news})", f"{news.partition('=')[0]} must")
        for news in ("start=(1, 2)", "start='x'", "speed='x'", "speed=nan", "speed=(1, 1, 1)")
        + ("curvature=nan", "movers=5", "movers=lane0(drives.movers)", "start=np.zeros((3, 2))")
    ]
    rows.append((of_drive.replace("drive_plans", "hit_plans"), "previous must"))
    of_block = "pj.replan(ReplanBlock(), blocks, block_plans, 0.1)"
    rows += [
        (of_block[:-1] + f", {news})", f"{news.partition('=')[0]} must")
        for news in ("angles=(0, 0)", "angles='x'", "rates=nan", "ball=5", "ball=hit.ball")
    ]
    rows.append((of_block.replace("ReplanBlock()", "blocker"), "OnlineBlock cannot plan again"))
    rows.append((of_block.replace("block_plans", "hit_plans"), "previous must"))
    return rows


def _gradients() -> list[tuple[str, str]]:
    gradient = "pj.gradient(exact, hits, **{**dict(of='cost', by='target'), **dict(@)})"
    rows = _of(gradient, "of", "'nothing'", "'stroke.nothing'", "5", "None", "''", "'stroke'")
    rows += _of(gradient, "of", "lambda plan: None", "lambda plan: plan.stroke.normal", "()")
    rows += _of(gradient, "by", "'nothing'", "5", "None", "''", "()", "(1,)", "'limits.nothing'")
    rows += _of(gradient, "steps", "-1", "1.5", "'x'", "True", "nan")
    rows += _of(gradient, "polish", "1", "'yes'", "None")
    rows += _of(gradient, "curvature", "'round'", "5", "['core']")
    rows += _of(gradient, "solver", "5", "'x'", "pj.Round()", "()", "pj.LbfgsConfig")
    rows += _of(gradient, "chunk", "0", "1.5") + _of(gradient, "devices", "()", "5")
    given = ", of='cost', by='target')"
    rows += [
        (f"pj.gradient(None, hits{given}", "planner must be one"),
        (f"pj.gradient(exact, None{given}", "ExactHit plans cases of the class HitCase"),
        (f"pj.gradient(exact, catches{given}", "ExactHit plans cases of the class HitCase"),
        (f"pj.gradient(pj.hit.planner('juggle'), hits{given}", "JuggleHit minimises nothing"),
        (f"pj.gradient(pj.hit.planner(ending='brake'), hits{given}", "plans with an ending have"),
        (f"pj.gradient(exact, filled(hits, 'drag', nan){given}", "drag must be finite"),
        ("pj.optimal_plan(exact, hits)", "case must be one case, got batch shape (2,)"),
        ("pj.optimal_plan(exact, None)", "ExactHit plans cases of the class HitCase"),
        ("pj.optimal_plan(None, hit)", "planner must"),
        ("pj.optimal_plan(exact, catches)", "ExactHit plans cases of the class HitCase"),
        ("pj.optimal_plan(pj.hit.planner('juggle'), hit)", "JuggleHit minimises nothing"),
        ("pj.optimal_plan(exact, hit, solver=5)", "solver must"),
        ("pj.optimal_plan(exact, hit, newton_steps=-1)", "newton_steps must"),
        ("pj.optimal_plan(exact, hit, newton_steps=1.5)", "newton_steps must"),
    ]
    return rows


def _judges() -> list[tuple[str, str]]:
    rows = []
    own = {"hit": "hits", "catch": "catches", "intercept": "drives", "block": "blocks"}
    plans = {"hit": "hit", "catch": "catch", "intercept": "drive", "block": "block"}
    for task, cases in own.items():
        mine = f"{plans[task]}_plans"
        other = "catch_plans" if task == "hit" else "hit_plans"
        strange = "catches" if task == "hit" else "hits"
        judge = f"pj.{task}.judge"
        for value in ("None", "5", strange, mine, f"[{cases}]"):
            rows.append((f"{judge}({value}, {mine})", "cases must be "))
        for value in ("None", "5", other, cases, f"[{mine}]"):
            rows.append((f"{judge}({cases}, {value})", "plans must be "))
        fewer = (f"first(1, {mine})", f"first(3, {mine})", f"lane0({mine})")
        rows += [(f"{judge}({cases}, {plan})", "plans must have the batch") for plan in fewer]
        rows.append((f"{judge}(lane0({cases}), {mine})", "plans must have the batch shape of"))
        rows.append((f"{judge}({cases}, {mine}.replace(cost='x'))", "cases and plans must hold"))
        call = f"{judge}({cases}, {mine}, @)"
        rows += _of(call, "tolerance", "-1", "nan", "inf", "'x'", "None", "(1, 2)", "1j", "[0.1]")
        rows += _of(call, "chunk", "0", "-1", "1.5", "'x'", "None")
        rows += _of(call, "tolerence", "0.1", words="tolerence")
    for task in ("hit", "catch"):
        call = f"pj.{task}.judge({own[task]}, {plans[task]}_plans, @)"
        rows += _of(call, "samples", "0", "100", "1e3", "'x'", "None", "nan")
        rows += _of(call, "contact_tolerance", "-1", "nan", "'x'", "None")
        rows += _of(call, "continuity_tolerance", "-1", "nan", "'x'")
    hit = "pj.hit.judge(hits, hit_plans, @)"
    rows += _of(hit, "landing_tolerance", "-1", "nan", "'x'", "(1, 2)")
    rows += _of(hit, "drag_after_impact", "'no'", "None", "5")
    rows += _of("pj.catch.judge(catches, catch_plans, @)", "net_test", "'box'", "None", "5", "[]")
    for task in ("intercept", "block"):
        call = f"pj.{task}.judge({own[task]}, {plans[task]}_plans, @)"
        rows += _of(call, "step", "0", "-1", "nan", "1.0", "'x'", "None", "(0.1, 0.1)")
    drive = "pj.intercept.judge(drives, drive_plans, @)"
    rows += _of(drive, "truth", "5", "'x'", "lane0(drives.target)", "hits")
    return rows


def _readings() -> list[tuple[str, str]]:
    rows = []
    rates = ("0", "-1", "nan", "inf", "'x'", "None", "(1, 2)", "1j", "True", "[100.0]")
    for plans in ("hit_plans", "lane0(hit_plans)", "catch_plans", "drive_plans", "block_plans"):
        rows += [(f"{plans}.sample({rate})", "rate must be") for rate in rates]
    for path in ("None", "5", "1.5", "['a']", "True"):
        rows.append((f"hit_plans.save({path})", "path must be the path of a file"))
    paths = ("None", "5", "'gone.npz'", "'.'", "'pipe'", "'/dev/null'", "'junk'", "'empty'", "''")
    rows += [(f"HitPlan.load({path})", "path must be") for path in paths]
    rows += [
        ("CatchPlan.load(saved(hit_plans))", "path must be a file of CatchPlan of version 1"),
        ("pj.Plan.load(saved(hit_plans))", "path must be a file of Plan of version 1"),
        ("hit_plans.replace(cost=None).save('new.npz')", "cost must be an array of numbers"),
        ("hit_plans.replace(cost='x').save('new.npz')", "cost must be an array of numbers"),
        ("hit_plans.replace(cost=object()).save('new.npz')", "cost must be an array of numbers"),
    ]
    for value in ("None", "5", "'x'", "hits.drag", "pj.hit"):
        rows.append((f"pj.require_sound({value})", "cases must be"))
        rows.append((f"pj.solved({value})", "plans must be"))
    rows += [(f"pj.task_named({value})", "task must be") for value in ("'x'", "5", "None", "[]")]

    path = "pj.predict_path(**{**PATH, **dict(@)})"
    rows += _of(path, "num_nodes", "4", "-1", "'x'", "None", "8.5", "nan", "True")
    rows += _of(path, "horizon", "0.0", "-1.0", "nan", "'x'", "None", "(1.0, 2.0)", "1j", "inf")
    rows += _of(path, "drag", "-1.0", "nan", "'x'", "None", "(1.0, 2.0)")
    rows += _of(path, "gravity", "nan", "'x'", "None", "(1.0, 2.0)")
    rows += _of(path, "ball", "None", "5", "hits")
    balls = ("hits.ball", "pj.BallState((0, 0), (1, 1))", "pj.BallState('x', 'y')")
    rows += _of(path, "ball", *balls, "pj.BallState(None, None)", words="ball.pos must ")
    at = "pj.target_at(@)"
    rows += [(at.replace("@", f"table, {time}"), "time must") for time in ("'x'", "None", "(1.0,)")]
    rows += [(at.replace("@", f"{table}, 0.1"), "table must") for table in ("None", "5", "hit")]
    fly = "pj.fly(**{**FLY, **dict(@)})"
    rows += _of(fly, "num_steps", "0", "-1", "1.5", "'x'", "None")
    rows += _of(fly, "duration", "nan", "'x'", "None", "(1.0, 2.0)")
    rows += _of(fly, "ball", "None", "5")
    rows += _of(fly, "ball", "hits.ball", words="ball.pos must have the shape (3,), got (2, 3)")
    walls = "pj.obstacles(**{**dict(polygons=[SQUARE]), **dict(@)})"
    rows += _of(walls, "polygons", "None", "5", "'x'", words="polygons must be a sequence")
    rows += _of(walls, "polygons", "[5]", "['x']", words="polygons must have corners")
    rows += _of(walls, "velocities", "'x'", "None", "(1, 2, 3)", "(nan, 0)", "np.zeros((2, 2))")
    rows += _of(walls, "room", "5", "(0, 0)", "(1,)", "'x'", "(1.5, 4)")
    rows += _of(walls, "dtype", "int", "'x'")
    return rows


ROWS = [
    *_cases(),
    *_draws(),
    *_planners(),
    *_plans(),
    *_replans(),
    *_gradients(),
    *_judges(),
    *_readings(),
]
