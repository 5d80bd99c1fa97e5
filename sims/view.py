"""A viewer of recorded flights in a web browser, with sliders for time and playing speed.

The viewer needs the extra `view`. `recording.frame` computes which objects are visible at a sample,
and this module displays them by the package viser. Flights play even if no browser is connected.
"""

import errno
import importlib
import ipaddress
import secrets
import socket
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from planner_jax.core.choices import require
from planner_jax.core.errors import ArgumentError
from planner_jax.core.missing_extra import MissingExtra
from planner_jax.runs.style import BLUE, GREEN, GREY, INK, RED, SKY
from planner_jax.sims.film import BALL_COLOURS
from planner_jax.sims.guard import guard_server
from planner_jax.sims.recording import Recording, frame
from planner_jax.sims.scenery import GROUND_COLOUR, Part, machine_parts, part_solid
from planner_jax.sims.task import FlightTask

_RATE = 30.0  # [Hz], rate of the displayed frames
_STEP = 0.01  # [s], step of the time slider


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return red, green, blue


def segments(path: np.ndarray) -> np.ndarray:
    """Return finite segments (K, 2, 3) of a path (P, 3); segments with NaN are left out."""
    pairs = np.stack([path[:-1], path[1:]], axis=1)
    return pairs[np.isfinite(pairs).all(axis=(1, 2))]


def free_address(host: str, port: int) -> str:
    """Return the numeric address of a name of this machine, after checking that a port is free.

    Port 0 stands for any free port.

    Raises:
        ArgumentError: there is no such address, or the port is taken; the message is one line that
            begins with `host` or `port`.
    """
    require(0 <= port <= 65535, "port", ">= 0 and <= 65535", port)
    own = ArgumentError("host", "an address of this machine", host)
    try:
        found = sorted(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))[0]
    except (socket.gaierror, UnicodeError):
        raise own from None
    with socket.socket(found[0]) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(found[4])
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise own from None
            raise ArgumentError("port", "free", shown=f"{port} ({error.strerror})") from None
    return str(found[4][0])


def _viser() -> Any:
    """Import and return the package viser.

    Raises:
        MissingExtra: viser is not installed.
    """
    try:
        return importlib.import_module("viser")
    except ModuleNotFoundError:
        raise MissingExtra("the viewer", "the package viser", "view") from None


class Viewer:
    """A server that displays one flight of a recording at a time.

    Attributes:
        url: address of the page, with the access token if the host is not the loopback address.
        flight: drop-down list; its `value` is the title of the displayed flight.
        time: slider; its `value` [s] is the displayed time.
        playing: check box, whether the flight plays.
        speed: slider; 1 is real time.
        reach: check box, whether to show where the robot could be; None if the task cannot compute
            this.
        robot: frames of the robot's shapes in the scene.
    """

    def __init__(
        self, task: FlightTask, recording: Recording, host: str = "localhost", port: int = 8080
    ):
        """Start the server, and display the first flight.

        Args:
            task: the task of the run.
            recording: the recorded flights.
            host: name or address of this machine, at which the page is served.
            port: port of the server; 0 selects any free port.

        Raises:
            ArgumentError: the page cannot be served at this address.
            MissingExtra: the package viser is not installed.
        """
        viser = _viser()
        address = free_address(host, port)
        self.task, self.world, self.recording = task, task.world(), recording
        self._titles = [task.title(recording, row) for row in range(len(recording))]
        is_own = ipaddress.ip_address(address.partition("%")[0]).is_loopback
        token = None if is_own else secrets.token_urlsafe(16)
        with guard_server({host, address}, token) as is_guarded:
            self._server = viser.ViserServer(address, port, label="planner-jax", verbose=False)
        if not is_guarded():
            self._server.stop()
            raise ArgumentError("viser", "a version that can be guarded", shown="another one")
        bound = self._server.get_port()
        if port and bound != port:  # another process took the port
            self._server.stop()
            raise ArgumentError("port", "free", port)
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{bound}"
        self.url += "" if token is None else f"/?token={token}"
        self._lock = threading.RLock()
        self._drawn: list[Any] = []
        self._scene, gui = self._server.scene, self._server.gui
        times = recording.time[0]
        self.flight = gui.add_dropdown("Flight", self._titles)
        self.playing = gui.add_checkbox("Play", True)
        first, last = round(float(times[0]), 3), round(float(times[-1]), 3)
        self.time = gui.add_slider("Time [s]", first, last, _STEP, first)
        self.speed = gui.add_slider("Speed", 0.1, 2.0, 0.1, 0.5)
        self.reach = None
        if task.HAS_REACH:
            self.reach = gui.add_checkbox("What can be reached", False)
        self._note = gui.add_markdown("")
        self._add_fixed_objects()
        self._draw_flight()
        self.flight.on_update(lambda _: self._draw_flight())
        self.time.on_update(lambda _: self._show())
        if self.reach is not None:
            self.reach.on_update(lambda _: self._draw_flight())

    @property
    def sample(self) -> int:
        """The index of the displayed sample of the recorded flight."""
        times = self.recording.time[self._row]
        nearest = int(np.argmin(np.abs(times - self.time.value)))
        return min(nearest, self.recording.num_samples(self._row) - 1)

    @property
    def _row(self) -> int:
        return self._titles.index(self.flight.value)

    def advance(self, seconds: float) -> None:
        """Advance the displayed time by `seconds` times the speed; restart after the end."""
        if self.playing.value:
            later = self.time.value + seconds * self.speed.value
            self.time.value = later if later <= self.time.max else self.time.min

    def run(self) -> None:
        """Play the selected flight until Ctrl-C is pressed, then stop the server."""
        try:
            before = time.monotonic()
            while True:
                time.sleep(1.0 / _RATE)
                now = time.monotonic()
                self.advance(now - before)
                before = now
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        """Stop the web server."""
        self._server.stop()

    def _add_fixed_objects(self) -> None:
        add = self._scene
        add.set_up_direction("+z")
        add.add_grid(
            "/ground",
            width=20.0,
            height=20.0,
            plane_color=_rgb(GROUND_COLOUR),
            plane_opacity=1.0,
            cell_thickness=0.0,
            section_thickness=0.0 if self.world.scenery else 1.0,
            position=(0.0, 0.0, -0.01),
        )
        self._add_parts("/scenery", self.world.scenery)
        self.robot = []
        flat = {"height": 0.004, "color": _rgb(SKY), "opacity": 0.5}
        for number, shape in enumerate(self.world.robot.shapes()):
            name = f"/robot{number}"
            self.robot.append(add.add_frame(name, show_axes=False))
            if shape.lines:
                pieces = np.concatenate([segments(line) for line in shape.lines])
                self._add_line(f"{name}/lines", pieces, BLUE, 0.012)
            for k, solid in enumerate(shape.solids):
                colour = SKY if shape.tool else shape.colour
                self._add_mesh(f"{name}/solid{k}", *solid, colour)
            for k, (place, radius) in enumerate(shape.discs):
                add.add_cylinder(f"{name}/disc{k}", radius, position=place, **flat)
        nothing = np.zeros((1, 2, 3))
        self._balls, self._trails = [], []
        for k in range(self.recording.balls.shape[2]):
            colour = BALL_COLOURS[k % len(BALL_COLOURS)]
            ball = add.add_icosphere(f"/ball{k}", self.task.THING_RADIUS, _rgb(colour))
            self._balls.append(ball)
            self._trails.append(self._add_line(f"/trail{k}", nothing, colour, 0.012))
        camera = self._server.initial_camera
        camera.position, camera.look_at = self.task.EYE
        self._prediction = self._add_line("/expected", nothing, RED, 0.006)

    def _add_line(self, name: str, pieces: np.ndarray, colour: str, thickness: float) -> Any:
        return self._scene.add_line_segments(name, pieces, _rgb(colour), thickness=thickness)

    def _add_mesh(self, name: str, corners: np.ndarray, triangles: np.ndarray, colour: str) -> Any:
        return self._scene.add_mesh_simple(
            name,
            corners.astype(np.float32),
            triangles.astype(np.uint32),
            color=_rgb(colour),
            flat_shading=True,
        )

    def _add_parts(self, name: str, parts: Sequence[Part]) -> list[Any]:
        drawn = []
        for number, part in enumerate(parts):
            style = {"color": _rgb(part.colour), "wxyz": part.quat_wxyz, "position": part.centre}
            if part.opacity < 1.0:
                style["opacity"] = part.opacity
            own = f"{name}/{number}"
            if part.corners:
                drawn.append(self._add_mesh(own, *part_solid(part), part.colour))
            elif part.kind == "box":
                drawn.append(self._scene.add_box(own, dimensions=part.size, **style))
            else:
                radius, height = 0.5 * part.size[0], part.size[2]
                drawn.append(self._scene.add_cylinder(own, radius, height, **style))
        return drawn

    def _draw_flight(self) -> None:
        with self._lock, self._server.atomic():
            recording, row = self.recording, self._row
            for part in self._drawn:
                part.remove()
            launch = recording.launch(row)
            drawn = self._add_parts(
                "/machine", machine_parts(*launch) if launch and self.world.mouth else []
            )
            flown = self.world.robot.place(recording.robot[row])
            paths = []
            for k, path in enumerate(np.moveaxis(flown.reshape(len(flown), -1, 3), 1, 0)):
                plan = recording.wanted[row].reshape(len(flown), -1, 3)[:, k]
                paths += [(f"/flown{k}", path, BLUE, 0.012), (f"/plan{k}", plan, INK, 0.006)]
            paths += [
                (f"/path{k}", recording.balls[row, :, k], GREY, 0.004)
                for k in range(recording.balls.shape[2])
            ]
            for name, path, colour, thickness in paths:
                drawn.append(self._add_line(name, segments(path), colour, thickness))
            points = [("/contact", place, RED) for place in recording.contact[row]]
            points.append(("/target", recording.target[row], GREEN))
            for number, (name, place, colour) in enumerate(points):
                if np.isfinite(place).all():
                    name, radius = f"{name}{number}", 1.5 * self.task.THING_RADIUS
                    dot = self._scene.add_icosphere(name, radius, _rgb(colour), position=place)
                    drawn.append(dot)
            self._prisms, self._layers = [], []
            for number, prism in enumerate(self.task.surroundings(int(recording.index[row]))):
                vertices, faces = prism.mesh()
                solid = self._add_mesh(f"/prism{number}", vertices, faces, prism.colour)
                self._prisms.append((prism, solid))
                drawn.append(solid)
            if self.reach is not None and self.reach.value:
                self._layers = list(self.task.reachable(int(recording.index[row])))
                self._cells = self._scene.add_point_cloud(
                    "/reach", np.zeros((1, 3), np.float32), _rgb(SKY), point_size=0.04
                )
                drawn.append(self._cells)
            self._drawn = drawn
            met = [f"{at:.2f} s" for at in recording.met[row] if np.isfinite(at)]
            word, none = self.task.CONTACT.capitalize(), f"No {self.task.THING} was met."
            self._note.content = f"{word} at {', '.join(met)}." if met else none
            self.time.value = self.time.min
            last = recording.num_samples(row) - 1
            self.time.max = round(float(recording.time[row, last]), 3)
            self._show()

    def _show(self) -> None:
        with self._lock, self._server.atomic():
            row, sample = self._row, self.sample
            robot = self.world.robot
            now = frame(self.recording, robot, row, sample)
            for shape, place in zip(self.robot, robot.places(now.robot), strict=True):
                shape.position, shape.wxyz = place
            for prism, solid in self._prisms:
                solid.position = (*(now.time * np.asarray(prism.velocity)), 0.0)
            path = segments(self.recording.expected[row, sample])
            self._prediction.visible = len(path) > 0
            if self._prediction.visible:
                self._prediction.points = path.astype(np.float32)
            if self._layers:
                nearest = np.argmin([abs(time - now.time) for time, _ in self._layers])
                points = self._layers[nearest][1]
                self._cells.points = np.pad(points, ((0, 0), (0, 1))).astype(np.float32)
                self._cells.colors = np.tile(np.array(_rgb(SKY), np.uint8), (len(points), 1))
            for k, (ball, trail) in enumerate(zip(self._balls, self._trails, strict=True)):
                ball.visible = bool(np.isfinite(now.balls[k]).all())
                if ball.visible:
                    ball.position = now.balls[k]
                behind = segments(self.recording.balls[row, : sample + 1, k])
                trail.visible = len(behind) > 0
                if trail.visible:
                    trail.points = behind.astype(np.float32)
