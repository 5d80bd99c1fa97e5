# ruff: noqa: E501
"""Bad calls of the library, which it must reject with one line.

A row has a call, as a user writes it, and the start of the expected error message.
`test_bad_calls.py` defines names in the calls, such as `hits`.
"""

# Malformed values, as Python text, for arguments of each kind, such as numbers or vectors.
NOT_NUMBERS = ("'x'", "None", "(1, 2)", "1j", "[[1.0]]", "b'1'", "object()")
NOT_SIZES = ("0", "-1", "1.5", "'2'", "None", "nan", "True", "(1,)")
NOT_VECTORS = ("'abc'", "None", "5.0", "[]", "(1, 2)", "(1j, 0, 1)", "((1, 2), (3,))", "object()")
NOT_SWITCHES = ("'no'", "5", "None")
NOT_NAMES = ("'nobody'", "5", "b'x'", "['a']", "''")
NOT_POSITIVE = ("-1", "nan", "inf", *NOT_NUMBERS)

HIT, CATCH = "pj.hit.case(**{**HIT, **dict(@)})", "pj.catch.case(**{**CATCH, **dict(@)})"
DRIVE, BLOCK = "pj.intercept.case(**{**DRIVE, **dict(@)})", "pj.block.case(**{**BLOCK, **dict(@)})"
TASKS = ("hit", "catch", "intercept", "block")
PATH, FLY = "pj.predict_path(**{**PATH, **dict(@)})", "pj.fly(**{**FLY, **dict(@)})"
GRADIENT = "pj.gradient(exact, hits, **{**dict(of='cost', by='target'), **dict(@)})"

# Calls in which "@" stands for `argument=value`, names of arguments, and malformed values of them.
ARGUMENTS = (
    (HIT, ("ball_pos", "ball_vel", "target"), NOT_VECTORS),
    (HIT, ("speed", "acceleration", "body_rate", "min_height"), ("-1", "nan", "inf", "'x'", "1j")),
    (HIT, ("gravity", "min_apex", "max_apex"), ("nan", *NOT_NUMBERS)),
    (CATCH, ("gravity",), NOT_POSITIVE),
    (CATCH, ("optional",), NOT_SWITCHES),
    (DRIVE, ("time", "tolerance", "length", "width", "wheelbase"), ("0", *NOT_POSITIVE[:3])),
    (DRIVE, ("initial_speed",), ("-1", "nan", "'x'", "None", "1j")),
    (DRIVE, ("speed", "acceleration", "curvature", "jerk"), ("0", "-1", "nan", "'x'")),
    (BLOCK, ("ball_pos", "ball_vel"), (*NOT_VECTORS[:6], "(nan, 0, 1)")),
    (BLOCK, ("delay",), ("-1", "nan", "'x'", "None", "1j")),
    (BLOCK, ("wide", "anywhere"), NOT_SWITCHES),
    ("pj.reach.solve_pose((0.5, 0, 0.5), np.eye(3), @)", ("is_roll_free",), NOT_SWITCHES),
    ("pj.reach.draw(@)", ("num",), NOT_SIZES),
    ("pj.reach.draw(2, @)", ("suite",), NOT_NAMES),
    *((f"pj.{task}.draw(@)", ("num",), (*NOT_SIZES, "2**70", "10**15")) for task in TASKS),
    *((f"pj.{task}.draw(2, @)", ("seed", "first"), ("-1", *NOT_SIZES[2:6])) for task in TASKS),
    *((f"pj.{task}.draw(2, @)", ("suite",), NOT_NAMES) for task in TASKS),
    *((f"pj.{task}.draw(2, @)", ("dtype",), ("int", "'float33'", "complex")) for task in TASKS),
    ("pj.hit.planner(@)", ("nodes",), NOT_SIZES),
    ("pj.catch.planner(@)", ("margin",), ("nan", "inf", "'x'", "None", "(1, 2)")),
    ("pj.catch.planner(@)", ("decide",), NOT_NAMES),
    ("pj.intercept.planner(@)", ("pieces",), NOT_SIZES[:5]),
    ("pj.block.planner(@)", ("brisk",), NOT_SWITCHES[:2]),
    ("pj.Attempt(@)", ("starts",), NOT_SIZES),
    ("pj.LbfgsConfig(@)", ("step_cap", "tolerance"), ("-1", "nan", "'x'", "None")),
    ("policy(@)", ("stretch",), ("0", "-1", "nan", "inf", "'x'", "None", "1j", "True")),
    ("Best(@)", ("finalists",), NOT_SIZES[:5]),
    ("pj.plan(exact, hits, @)", ("chunk",), tuple(x for x in NOT_SIZES if x != "None")),
    (GRADIENT, ("steps",), ("-1", "1.5", "'x'", "True", "nan")),
    *(
        (f"pj.{task}.judge({cases}, {plans}, @)", ("tolerance",), ("-1", "nan", "inf", "'x'"))
        for task, cases, plans in (
            ("hit", "hits", "hit_plans"),
            ("catch", "catches", "catch_plans"),
            ("intercept", "drives", "drive_plans"),
            ("block", "blocks", "block_plans"),
        )
    ),
    (PATH, ("num_nodes",), NOT_SIZES),
    (PATH, ("horizon",), ("0.0", *NOT_POSITIVE)),
    (FLY, ("num_steps",), NOT_SIZES[:5]),
)

# One row a line: a call, and the start of the expected error message.
_ROWS = """
pj.hit.case(**{**HIT, **dict(target=(1e60, 0, 0))}) | target must be finite, got
pj.hit.case(**{**HIT, **dict(start=(0, 0, 0.2))}) | start must be at a height >= min_height
pj.hit.case(**{**HIT, **dict(restitution=1.01)}) | restitution must be in [0, 1], got 1.01
pj.hit.case(**{**HIT, **dict(min_apex=7.0)}) | min_apex must be < max_apex, got 7
pj.hit.case(**{**HIT, **dict(extras=(5,))}) | extras must have a method excess or cost, got 5
pj.hit.case(**{**HIT, **dict(extras=(pj.KeepOut((0, 0), 1.0),))}) | extras.0 must be for one case, got
pj.hit.case(**{**HIT, **dict(extras=(pj.KeepOut((0, 0, 1), -1.0),))}) | extras.0.radius must be > 0
pj.hit.case(**{**HIT, **dict(dtype=np.float64)}) | dtype must be float32 unless
pj.hit.case(**{**HITS, **dict(ball_vel=np.zeros((3, 3)))}) | ball_vel must have the shape
pj.catch.case(**{**CATCH, **dict(horizon=(1, -1))}) | horizon must be > 0 of a target that is present
pj.catch.case(**{**CATCH, **dict(targets=turning(2))}) | targets must
pj.catch.case(**{**CATCH, **dict(present=(0.5, 1.0))}) | present must be True or False of each target
pj.catch.case(**{**CATCH, **dict(max_angle=4)}) | max_angle must be in [0, pi], got 4
pj.catch.case(**{**CATCH, **dict(min_thrust=30.0)}) | min_thrust must be < max_thrust, got 30
pj.intercept.case(**{**DRIVE, **dict(initial_curvature=nan)}) | initial_curvature must be finite
pj.intercept.case(**{**DRIVE, **dict(walls=[SQUARE, 5])}) | walls must have corners
pj.intercept.case(**{**DRIVE, **dict(movers=[SQUARE[[0, 2, 1, 3]]])}) | movers must
pj.intercept.case(**{**DRIVE, **dict(mover_velocities=(nan, 0))}) | mover_velocities must be finite
pj.intercept.case(**{**DRIVE, **dict(lower=(9, 9))}) | lower must be < upper, got 9
pj.group.case(turning(3), present=(1, 0, 1)) | present must be True or False of 3 targets
pj.block.case(**{**BLOCK, **dict(regime='R9')}) | regime must be one of R1
pj.block.case(**{**BLOCK, **dict(scene=5)}) | scene must be a Scene, got a int
pj.block.case(**{**BLOCK, **dict(angles=(nan, 0, 0, 0, 0, 0))}) | angles must be finite
pj.hit.draw(2, limit_scale=1e9) | limit_scale must be from 0.001 to 1000
pj.hit.draw(2, delay=9.0) | delay must be shorter than each serve's flight
pj.hit.planner('nobody') | planner must be one of exact
pj.hit.planner('exact:file') | planner must be exact without a file
pj.hit.planner(attempt=3) | option of planner exact must be one of
pj.block.planner('library:') | planner must name
pj.block.planner('library:gone') | library must be a file, got 'gone'
pj.catch.planner(decide='policy:gone') | checkpoint must be
pj.hit.planner(attempts=(pj.LbfgsConfig(),)) | attempts must
pj.hit.planner(attempts=()) | attempts must have an entry
pj.group.planner(decide='nobody') | decide must be one of
pj.plan('exact', hits) | planner must be one, such as
pj.plan(exact, catches) | cases must be of the class HitCase, which HitProblem plans, got a CatchCase
pj.solve(catcher, hits) | cases must be of the class CatchCase
pj.plan(exact, having(hits, 'drag', np.zeros(3, np.float32))) | drag must have the shape (2,), got (3,)
pj.plan(exact, fill(hits, 'target', nan)) | target must be finite, got nan in lane 0 (1 more such lane)
pj.plan(exact, fill(hits, 'hit_limits.min_apex', 9.0)) | hit_limits.min_apex must be < hit_limits.max_apex
pj.plan(catcher, fill(catches, 'order', 1)) | order must be a permutation
pj.plan(catcher, having(catches, 'targets', None)) | targets must be given, got None
pj.plan(exact, jax.tree.map(np.float16, hits)) | ball.pos must be in float32 or float64
pj.plan(exact, pj.take(hits, slice(0, 0))) | cases must be a batch of at least one
pj.plan(exact, hits, devices=[0]) | devices must be a sequence of jax.Device
pj.replan(exact, hits, hit_plans, -0.1, ball=hits.ball) | elapsed must
pj.replan(exact, hits, catch_plans, 0.1, ball=hits.ball) | previous must
pj.replan(exact, hits, hit_plans, 0.1, ball=hits.ball, drag=-1.0) | case.drag must be >= 0, got -1
pj.replan(catcher, catches, catch_plans, 0.1, targets=hits.ball) | targets must
pj.replan(driver, drives, drive_plans, 0.1, target=drives.target, speed=nan) | speed must
pj.replan(blocker, blocks, block_plans, 0.1, rates=nan) | rates must
pj.replan(pj.block.planner("direct"), blocks, block_plans, 0.1) | DirectBlock cannot plan again
pj.gradient(exact, hits, of=5, by='target') | of must
pj.gradient(exact, hits, of='cost', by='limits.nothing') | by must
pj.sensitivity(exact, catches) | cases must be of the class HitCase
pj.optimal_plan(exact, hits) | case must be one case, got batch shape (2,)
pj.hit.judge(hits, catch_plans) | plans must be a HitPlan, got a CatchPlan
pj.catch.judge(catches, catch_plans, net_test='box') | net_test must
pj.hit.judge(hits, hit_plans, tolerence=0.1) | tolerence must be a setting of the referee
pj.intercept.judge(drives, drive_plans, truth=5) | truth must
pj.block.judge(blocks, first(3, block_plans)) | plans must have the batch shape of the cases
hit_plans.sample(0) | rate must be
hit_plans.save(5) | path must be the path of a file
HitPlan.load('junk') | path must be
CatchPlan.load(save(hit_plans)) | path must be a file of CatchPlan of version 1
pj.require_sound(5) | cases must be a case or a batch, got a int
pj.are_solved(hits.drag) | plans must be
pj.task_named('x') | task must be one of
pj.target_at('x', 0.1) | table must
pj.durations_of((0.0, 1.0), 'log') | kind must be one of exp, rational, got 'log'
pj.minco(np.eye(5, 3), np.eye(5, 3), np.ones((1, 3)), np.ones(2)) | head must be of 2, 3 or 4 rows
pj.table_path(**{**TABLE, **dict(times=(0, 1, 1))}) | times must be finite and rise
pj.obstacles([SQUARE], velocities=(1, 2, 3)) | velocities must have the shape
"""


def _split(line: str) -> tuple[str, str]:
    call, _, begins = line.rpartition(" | ")
    return call.strip(), begins


ROWS = [_split(line) for line in _ROWS.strip().splitlines()]
