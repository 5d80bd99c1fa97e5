"""Command-line options of `planner-jax library`; importing this module does not import JAX."""

from collections.abc import Callable


def add_commands(command: Callable[[str, str], Callable[..., None]]) -> None:
    """Add the subcommands build, show, check and repair of `planner-jax library`.

    Each subcommand calls the function of `library.command` with its name and "_library".

    Args:
        command: function that adds a subcommand from its name and help sentence. It returns a
            function that adds an option, with the arguments of `ArgumentParser.add_argument`.
    """
    build = command("build", "plan for every pair of cells; continues an interrupted build")
    build("--layout", metavar="NAME", help="full, or A, B, C, D of fewer (default: full)")
    build("--regime", metavar="NAME", help="limits of the joints: R1, R2, R3 (default: R2)")
    method = (
        "planner of the motions: least-squares or insat, of [Natarajan2024] (default: the first)"
    )
    build("--planner", metavar="NAME", help=method)
    build("--no-pole", dest="pole", action="store_false", help="the scene without its pole")
    build("--arm", metavar="FILE", help="an MJCF or URDF file (default: the IRB 1600)")
    angles = "six angles [rad] of the arm's home, or six for each of several homes"
    build("--home", type=float, nargs="+", metavar="Q", help=angles)
    show = command("show", "print coverage, memory and hashes of a library")
    show("--map", metavar="FILE", help="write a picture of the coverage")
    check = command("check", "referee stored motions for random balls")
    check("--num", type=int, metavar="N", help="balls for each home (default: 2000)")
    check("--seed", type=int, metavar="K", help="of the balls (default: 0)")
    repair = command("repair", "plan again the motions that touch a pole that has moved")
    place = "new position of the pole [m]"
    repair("--pole", type=float, nargs=2, metavar="M", help=place, required=True)
    repair("--out", metavar="FILE", help="of the new library", required=True)
    repair("--retry", action="store_true", help="also plan for pairs without a motion")
