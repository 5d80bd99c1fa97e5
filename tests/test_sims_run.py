"""Run folders of flights, films, and the command `planner-jax fly`."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from planner_jax.cli import main
from planner_jax.sweep.settings import SettingError
from sims.closed_loop import Record
from sims.film import FilmError, film_flights, require_film
from sims.model import NET, World, hovering
from sims.run import FlySettings


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"task": "block"}, "task must be one of catch, hit, got 'block'"),
        ({"task": "catch", "noise": "loud"}, "noise must be one of none, lab, harsh, got 'loud'"),
        ({"task": "catch", "num": 0}, "num must be >= 1, got 0"),
        (
            {"task": "catch", "replan": 30.0},
            "replan must be a divisor of the looks' 100 Hz, got 30",
        ),
        ({"task": "hit", "balls": 2}, "balls must be 1 for hits, got 2"),
        (
            {"task": "hit", "planner": "juggle", "replan": 50.0},
            "replan must be 0 for other planners, got 50.0",
        ),
        ({"task": "catch", "drag_error": -0.1}, "drag_error must be >= 0 and < 1, got -0.1"),
    ],
)
def test_settings_that_break_a_rule_are_refused_in_one_line(given, message):
    with pytest.raises(SettingError) as error:
        FlySettings(**given)
    assert str(error.value) == message


def test_the_command_says_what_is_wrong_and_writes_nothing(tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["fly", "catch", "--noise", "loud", "--out", str(out)]) == 2
    assert main(["fly", "hit", "--video", "film.avi", "--out", str(out)]) == 2
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith("planner-jax: error:")]
    assert "--noise must be one of none, lab, harsh" in said[0]
    assert "--video must end in .gif or .mp4" in said[1]
    assert not out.exists()


def record():
    """Four looks at a hovering quadrotor, and a ball that falls."""
    qpos = np.tile(np.asarray(hovering(World(NET), np.array([0.0, 0.0, 1.0])).qpos), (4, 1))
    qpos[:, 7:] = [[0.5, 0.0, 2.0 - 0.1 * k] for k in range(4)]
    physics = hovering(World(NET), np.zeros(3)).replace(qpos=qpos)
    return Record(
        time=0.01 * np.arange(4.0),
        physics=physics,
        wanted=qpos[:, :3],
        horizon=np.ones((4, 1)),
        error=np.zeros((4, 1, 3)),
    )


def test_a_film_is_written_without_a_display(tmp_path):
    path = tmp_path / "flights.gif"
    film_flights(path, World(NET), [record()], [[np.nan]], ["one"], [[]])
    assert path.read_bytes()[:4] == b"GIF8"
    assert list(tmp_path.iterdir()) == [path]


def test_a_film_that_fails_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(Figure, "clear", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        film_flights(tmp_path / "flights.gif", World(NET), [record()], [[np.nan]], ["one"], [[]])
    assert not list(tmp_path.iterdir())


def test_mp4_without_ffmpeg_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FilmError, match="^video must end in .gif where ffmpeg is not installed"):
        require_film(tmp_path / "flights.mp4")


@pytest.mark.slow
def test_a_run_of_flights_is_written_whole(tmp_path, capsys):
    out = tmp_path / "run"
    command = ["fly", "catch", "--num", "3", "--batch", "2", "--noise", "none", "--replan", "0"]
    assert main([*command, "--video", "--out", str(out)]) == 0
    assert "100.00 % of 3 flights caught all balls" in capsys.readouterr().out
    names = {path.name for path in out.iterdir()}
    assert names == {
        "manifest.json",
        "plans.parquet",
        "table.md",
        "index.html",
        "figures",
        "flights.gif",
    }
    assert main(["report", str(out)]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said == ["planner-jax: error: RUN must be the folder of a sweep, got a fly catch"]
