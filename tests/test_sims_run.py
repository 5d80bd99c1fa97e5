"""Run folders of flights, films, and the command `planner-jax fly`."""

import pytest
from matplotlib.figure import Figure

from planner_jax.cli import main
from planner_jax.sims.film import FilmError, draw_flight, film_flights, require_film
from planner_jax.sims.model import NET, RACKET, World
from planner_jax.sims.run import FlySettings
from planner_jax.sweep.settings import SettingError
from tests.recordings import recording


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
    assert main(["fly", "hit", "--record", "0", "--out", str(out)]) == 2
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith("planner-jax: error:")]
    assert "--noise must be one of none, lab, harsh" in said[0]
    assert "--video must end in .gif or .mp4" in said[1]
    assert "--record must be >= 1 and <= 256, got 0" in said[2]
    assert not out.exists()


def test_a_film_is_written_without_a_display(tmp_path):
    path = tmp_path / "flights.gif"
    film_flights(path, World(NET), recording(), ["one"])
    assert path.read_bytes()[:4] == b"GIF8"
    assert list(tmp_path.iterdir()) == [path]


def test_a_film_that_fails_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(Figure, "clear", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        film_flights(tmp_path / "flights.gif", World(NET), recording(), ["one"])
    assert not list(tmp_path.iterdir())


def test_a_picture_of_a_hit_shows_court_machine_and_target(tmp_path):
    path = tmp_path / "flight.png"
    draw_flight(path, World(RACKET), recording(target=(1.75, 0.0, 0.0)), 0, "one")
    assert path.read_bytes()[1:4] == b"PNG"


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
        "flights.parquet",
        "table.md",
        "index.html",
        "figures",
        "flights.gif",
    }
    page = (out / "index.html").read_text()
    for name in ("index.html", "table.md", "figures/flight.png"):
        (out / name).unlink()
    assert main(["report", str(out)]) == 0
    assert "100.00 % of 3 flights caught all balls" in capsys.readouterr().out
    assert (out / "figures" / "flight.png").exists() and (out / "table.md").exists()
    assert (out / "index.html").read_text() == page
    (out / "flights.parquet").unlink()
    assert main(["report", str(out)]) == 2
    assert "RUN must be finished, with its flights.parquet" in capsys.readouterr().err
