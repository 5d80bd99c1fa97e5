"""Malformed options and files, a line each, that every command has to refuse in one line.

A row is a command line, and words that the one line on the standard error stream has to hold. The
names `pipe`, `folder`, `empty`, `junk` and `gone` stand for paths of those kinds.
"""

NOT_WHOLE = ("ten", "", " 5", "1.5", "1e3", "4_3", "٣", "１２", "0x10", "nan", "9" * 500)
NOT_NUMBERS = ("x", "", "1_0", "٣", "1,5", "0x1p3", "--")
FILES = ("pipe", "folder", "empty", "junk", "gone", "/dev/zero")
TASKS = ("hit", "catch", "intercept", "block")


def _of(command: str, option: str, values: tuple[str, ...], *words: str) -> list:
    """Rows of one option, whose name the line begins with."""
    return [((*command.split(), option, value), (option, *words)) for value in values]


def _rows() -> list:
    rows = []
    for task in TASKS:
        for option in ("--num", "--batch", "--seed"):
            rows += _of(f"sweep {task}", option, NOT_WHOLE)
        for option in ("--num", "--batch", "--record"):
            rows += _of(f"fly {task}", option, ("0", "-1", "x", "1.5", "4_3", "٣", "1" + "0" * 15))
        rows += _of(f"sweep {task}", "--num", ("0", "-4"), "must be >= 1")
        rows += _of(f"sweep {task}", "--num", ("1" + "0" * 15,), "must be at most")
        rows += _of(f"sweep {task} --num 1000000", "--batch", ("1000000000",), "memory")
        rows += _of(f"sweep {task}", "--seed", ("-1", "9" * 20, str(2**63)), "must be")
        rows += _of(f"sweep {task}", "--planner", ("", ":", "nobody", "é", "exact:file"))
        rows += _of(f"sweep {task}", "--suite", ("", "nowhere", "court\nx"))
        rows += _of(f"sweep {task} --num 1", "--out", ("", "pipe", "/dev/null", "junk/below"))
        rows += _of(f"sweep {task} --num 1", "--workers", ("", "2", "Ray"), "must be ray")
        rows += _of(f"sweep {task} --resume", "--out", ("pipe", "folder", "gone"))
        rows += [((*f"sweep {task}".split(), "stray"), ("unrecognized", "stray"))]
        rows += _of(f"fly {task}", "--planner", ("", "nobody", "exact:file"))
        rows += _of(f"fly {task}", "--replan", ("-1", "nan", "inf", "1e300"))
        rows += _of(f"fly {task}", "--seed", ("-1", "9" * 20))
        rows += _of(f"fly {task}", "--out", ("", "pipe", "/dev/null"))
        rows += _of(f"fly {task}", "--video", ("a/b.gif", "x.avi", ""))
    for task in ("hit", "catch"):
        scales = ("0", "-1", "1e-300", "1e300", "nan", "inf")
        rows += _of(f"sweep {task}", "--limit-scale", scales, "from 0.001 to 1000")
        rows += _of(f"sweep {task}", "--limit-scale", NOT_NUMBERS)
        rows += _of(f"sweep {task}", "--effort", ("", "Best", "more"), "must be one of feasible")
        rows += _of(f"sweep {task}", "--ending", ("", "Brake", "land"), "must be one of none")
        rows += _of(f"fly {task}", "--noise", ("x", ""))
        rows += _of(f"fly {task}", "--drag-error", ("nan", "1", "-0.1", "x"))
    rows += _of("sweep hit", "--delay", ("nan", "inf", "-1", "1e300", "3", *NOT_NUMBERS))
    for point in (
        "nan 0 1",
        "1 2",
        "1 2 3 4",
        "0 0 -1",
        "x 0 1",
        "1_0 0 1",
        "1e300 0 1",
        "uniform 1",
    ):
        rows += [(("sweep", "hit", "--num", "1", "--start", *point.split()), ("--start",))]
    rows += _of("sweep hit", "--serves", FILES)
    decisions = [f"policy:{file}" for file in FILES]
    rows += [
        (("sweep", "catch", "--num", "1", "--decide", word), ("checkpoint",)) for word in decisions
    ]
    rows += _of("sweep catch", "--decide", ("policy:", "best:x", "later", ""))
    rows += _of("sweep catch", "--tolerance", ("nan", "-1", "inf", *NOT_NUMBERS))
    rows += _of("sweep catch", "--net-test", ("box", "Ball", ""))
    for kind in ("library", "adapt"):
        words = [f"{kind}:{file}" for file in FILES]
        rows += [
            (("sweep", "block", "--num", "1", "--planner", word), ("library must be",))
            for word in words
        ]
        rows += _of("sweep block", "--planner", (kind, f"{kind}:"), "file")
    for option in ("--delay", "--count", "--sense", "--overhead", "--wait", "--noise", "--refit"):
        rows += _of("sweep block", option, ("-1", "nan", "inf", "1e300", "x"))
    rows += _of("sweep block", "--frame-rate", ("0", "nan", "1e-300", "1e300"))
    rows += _of("sweep block", "--regime", ("R9", ""))
    rows += _of("fly catch", "--balls", ("0", "-1", "13", "x", "1" + "0" * 15))
    rows += _of("fly catch", "--redecide", ("nan", "7", "-1"))
    rows += _of("fly catch", "--decide", ("given", "best:x", "policy:"))
    rows += _of("fly intercept", "--latency", ("nan", "-1", "1e300"))
    rows += _of("fly intercept", "--looks", ("nan", "-1", "1e300"))
    rows += _of("fly intercept", "--noise", ("x",))
    for option in ("--lag", "--latency", "--sense", "--allowed"):
        rows += _of("fly block", option, ("nan", "-1", "1e300"))
    rows += _of("fly block", "--torque", ("0", "nan", "1e-300", "1e300"))
    rows += _of("fly block", "--mass-error", ("nan", "2", "-1"))
    rows += _of("fly block", "--encoders", ("x",))
    rows += [
        ((command, name), ("RUN must be",)) for command in ("report", "view") for name in FILES
    ]
    rows += [(("export", name, "--row", "0", "--to", "csv"), ("RUN must be",)) for name in FILES]
    hit = "plan hit --vel -3 0.2 4 --target 4 0 0"
    catch = "plan catch --pos 3 0 1 --vel -3 0.2 4"
    for point in ("1 2", "1 2 3 4", "x 0 1", "1 -nan 2", "nan 0 1", "0 inf 1", "1_0 0 1", "-1e3"):
        rows.append(((*hit.split(), "--pos", *point.split()), ()))
    rows += _of(f"{hit} --pos 4 0 1", "--planner", ("", "nobody"), "must be one of")
    rows += _of(f"{hit} --pos 4 0 1", "--ending", ("", "land"), "must be one of none, brake")
    for option in ("--speed", "--body-rate", "--acceleration", "--min-height", "--gravity"):
        rows += _of(f"{hit} --pos 4 0 1", option, ("nan", "inf", *NOT_NUMBERS))
    rows += _of(f"{hit} --pos 4 0 1", "--out", ("", "folder", "pipe", "junk/below"), "must")
    rows += _of(f"{hit} --pos 4 0 1 --out new", "--rate", NOT_NUMBERS)
    rows += _of(catch, "--horizon", ("nan", "inf", *NOT_NUMBERS))
    rows += _of(f"{catch} --horizon 1", "--decide", ("", "later", "best:x"))
    rows += [
        ((*hit.split(),), ("--pos",)),
        ((*catch.split(),), ("--horizon",)),
        (("plan", "catch", "--horizon", "1", "--ball", "1", "2", "3"), ("--ball",)),
        (("plan", "block"), ("block",)),
    ]
    rows += [(("compare", name, name), ("RUN must be",)) for name in FILES]
    rows += _of("compare junk junk", "--out", ("", "x.txt"), "must")
    rows += _of("export junk --row 0", "--to", ("", "cvs", "px4\nx"), "must be one of csv")
    rows += _of("export junk --row 0 --to csv", "--ending", ("", "land"), "must be one of none")
    rows += _of("export junk --to csv", "--row", NOT_WHOLE)
    rows += _of("export junk --to csv", "--rate", NOT_NUMBERS)
    rows += _of("export junk --to px4", "--udp", NOT_WHOLE)
    rows += _of("export junk --to csv", "--out", ("",))
    for task in ("hit", "catch"):
        rows += _of(f"serve {task}", "--port", ("-1", "65536", "1" + "0" * 15, *NOT_WHOLE))
        rows += _of(f"serve {task}", "--rate", ("0", "1e300", "nan", *NOT_NUMBERS))
        rows += _of(f"serve {task}", "--deadline", ("0", "10", "nan", "inf", "-1", "x"))
        rows += _of(f"serve {task}", "--robot", ("", "nobody", "gone.yaml"), "--robot must be")
        rows += _of(f"serve {task}", "--horizon", ("0", "18", "1.5", "x"))
        rows += _of(f"serve {task}", "--noise", ("0", "9", "nan"))
        rows += _of(f"serve {task}", "--drag", ("-1", "nan", "99"))
        rows += _of(f"serve {task}", "--seconds", ("0", "-1", "nan", "inf"))
    rows += [
        (("serve", "hit", "--target", *place.split()), ("--target",)) for place in ("1 2", "x")
    ]
    rows += _of("library build new", "--home", ("x", "1"))
    rows += [
        (("library", "build", "new", "--home", *["nan"] * 6), ("--home", "finite")),
        (("library", "repair", "junk", "--pole", "1", "--out", "new"), ("--pole",)),
        (("library", "repair", "junk", "--out", "new"), ("--pole",)),
    ]
    rows += _of("library build new", "--arm", FILES)
    rows += _of("library build new", "--layout", ("x",)) + _of(
        "library build new", "--regime", ("x",)
    )
    for word in ("show", "check"):
        rows += [(("library", word, name), ("library must be",)) for name in FILES]
    rows += [
        (("library", "build", name), ("library must be",)) for name in ("junk", "empty", "folder")
    ]
    rows += _of("library check junk", "--num", ("0", "x", "1" + "0" * 15))
    rows += _of("library check junk", "--seed", ("-1", "9" * 20))
    rows += _of("bench throughput", "--task", ("x", ""))
    rows += _of("bench throughput", "--planner", ("x",)) + _of(
        "bench throughput", "--suite", ("x",)
    )
    rows += _of("bench throughput", "--batch", ("0", "x", "1" + "0" * 15))
    rows += _of("bench throughput", "--devices", ("0", "1000", "x"))
    rows += _of("bench throughput", "--repeat", ("0", "x", "9" * 20))
    rows += _of("bench throughput", "--iterations", ("0", "9" * 20))
    rows += _of("bench throughput", "--out", ("", "pipe"))
    rows += _of("train", "--suite", ("x", "", "parabola1,"))
    rows += _of("train", "--decisions", ("0", "nan", "inf", "1e300", "x"))
    rows += _of("train", "--learning-rate", ("0", "nan", "x"))
    rows += _of("train", "--lanes", ("1", "x", "1" + "0" * 15))
    for option in ("--judged", "--seed"):
        rows += _of("train", option, ("-1", "x", "9" * 30))
    rows += _of("train", "--network", ("x",))
    rows += _of("view folder", "--port", ("x", "1_0", "", "٣"))
    rows.append((("compare",), ("RUN",)))
    for words in ("", "plan", "sweep", "fly", "serve", "library", "bench", "nobody", "doctor x"):
        rows.append((tuple(words.split()), ()))
    return rows


ROWS = _rows()
