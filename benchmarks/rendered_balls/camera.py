# Pyright cannot see the names of MuJoCo's compiled module.
# pyright: reportAttributeAccessIssue=false
"""A simulated camera beside the arm: colour and depth images, rendered off-screen by MuJoCo.

Positions are in the robot's base frame, z up, in SI units. The scene contains the arm, a pole as
obstacle, the beams around the arm, a floor, walls and a ball. The light is even, and the exposure
takes no time, so that images have no motion blur.

Rendering needs OpenGL without a display. The default is EGL; MuJoCo's environment variable
`MUJOCO_GL` selects another library.
"""

import importlib.resources
import os
import xml.etree.ElementTree as ET
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from planner_jax.benchmarks.rendered_balls.segment import (
    BallThresholds,
    Sighting,
    noisy_depth,
    sighting,
)
from planner_jax.core.errors import PlannerJaxError
from planner_jax.robot.arm_scene import Scene
from planner_jax.sims.perception.camera import Camera
from planner_jax.sims.perception.noise import StereoNoise
from planner_jax.sims.scenery import GROUND_COLOUR, xml_colour, xml_numbers

_ARM = importlib.resources.files("planner_jax.robot") / "models" / "irb1600.xml"
_WALLS, _HIGH = 13.0, 6.0  # [m], distance of the walls from the arm, and height of the walls
_NEAR, _FAR = 0.1, 40.0  # [m], clipping distances of the renderer
_BALL, _POLE, _STEEL, _ARM_COLOUR, _WALL = "#FF7A0A", "#E59BC0", "#A7AFB5", "#D9D9D4", "#9AA7B4"


class RenderError(PlannerJaxError, RuntimeError):
    """Rendering is impossible on this machine; the message is a single line."""


class SceneCamera:
    """A camera that renders images of the scene around the arm.

    Close the camera after use, or use it in a `with` statement.
    """

    def __init__(
        self, camera: Camera, scene: Scene, *, ball_radius: float = 0.05, arm_xml: str | None = None
    ):
        """Create the scene and the OpenGL context.

        Args:
            camera: size, focal length and pose of the camera, in NumPy arrays.
            scene: the obstacles around the arm in one case.
            ball_radius: [m], radius of the ball.
            arm_xml: MJCF text of the arm; by default the IRB 1600 of [Natarajan2024].

        Raises:
            RenderError: OpenGL is not available.
        """
        text = _ARM.read_text("utf-8") if arm_xml is None else arm_xml
        self.camera = camera
        self._model = _scene_model(text, camera, scene, ball_radius)
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:6] = self._model.key("home").qpos
        width, height = camera.size
        try:
            self._context: Any = _context_class()(width, height)
            self._context.make_current()
            self._to: Any = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        # The type of the exception depends on which OpenGL library is missing.
        except Exception as error:
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise RenderError(
                f"images need OpenGL without a display, EGL or what MUJOCO_GL names: {reason}"
            ) from None
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._to)
        self._to.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = self._model.camera("eye").id
        self._shown = mujoco.MjvScene(self._model, maxgeom=200)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._shown.flags[flag] = False

    def __enter__(self) -> "SceneCamera":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """Release the renderer and the OpenGL context."""
        self._to.free()
        self._context.free()

    def take(
        self, ball: np.ndarray | None, angles: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Render one frame, without noise.

        Args:
            ball: (3,) [m], centre of the ball; None for a scene without a ball.
            angles: (6,) [rad], joint angles of the arm; by default the angles of the previous
                frame, and for the first frame the pose `home` of the arm's model.

        Returns:
            image: (rows, columns, 3) bytes, red, green and blue.
            depth: (rows, columns) [m] along the camera's axis.
        """
        if angles is not None:
            self._data.qpos[:6] = angles
        away = np.array([0.0, 0.0, -100.0])
        self._data.mocap_pos[0] = away if ball is None else ball
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        every = mujoco.mjtCatBit.mjCAT_ALL
        option = mujoco.MjvOption()
        mujoco.mjv_updateScene(
            self._model, self._data, option, None, self._view, every, self._shown
        )
        width, height = self.camera.size
        image = np.empty((height, width, 3), np.uint8)
        far_to_near = np.empty((height, width), np.float32)
        whole = mujoco.MjrRect(0, 0, width, height)
        self._context.make_current()
        mujoco.mjr_render(whole, self._shown, self._to)
        mujoco.mjr_readPixels(image, far_to_near, whole, self._to)
        # The depth buffer is linear in 1 / depth: 0 at the far plane, 1 at the near plane.
        extent = self._model.stat.extent
        near, far = self._model.vis.map.znear * extent, self._model.vis.map.zfar * extent
        closeness = 1.0 / far + far_to_near[::-1].astype(float) * (1.0 / near - 1.0 / far)
        return image[::-1], (1.0 / closeness).astype(np.float32)


@jax.jit
def measure_ball(
    key: Array, image: Array, depth: Array, camera: Camera, noise: StereoNoise, ball: BallThresholds
) -> Sighting:
    """Detect a ball in a rendered frame, after adding a stereo camera's noise to the depth.

    Args:
        key: random key of the noise.
        image: (rows, columns, 3) bytes.
        depth: (rows, columns) [m], without noise.
        camera: the camera at its calibrated pose.
        noise: parameters of the depth noise.
        ball: thresholds that separate the ball from the background.
    """
    seen, confidence = noisy_depth(key, camera, noise, depth)
    return sighting(image, seen, confidence, camera, ball)


def measure_balls(
    eye: SceneCamera,
    places: np.ndarray,
    noise: StereoNoise,
    ball: BallThresholds,
    *,
    seed: int = 0,
    believed: Camera | None = None,
) -> np.ndarray:
    """Return measured positions (N, 3) [m] of a ball in N rendered frames; NaN if invisible.

    Args:
        eye: the camera that renders the frames; the arm stands still.
        places: (N, 3) [m], true positions of the ball's centre.
        noise: parameters of the depth noise.
        ball: thresholds that separate the ball from the background.
        seed: random seed of the noise.
        believed: the camera at its calibrated pose; by default at its true pose.
    """
    camera = eye.camera if believed is None else believed
    keys = jax.random.split(jax.random.key(seed), len(places))
    found = [
        measure_ball(key, *map(jnp.asarray, eye.take(place)), camera, noise, ball).place
        for key, place in zip(keys, np.asarray(places, float), strict=True)
    ]
    return np.array(found)


def _context_class() -> Any:
    """Return MuJoCo's class of OpenGL contexts: EGL unless `MUJOCO_GL` selects another library."""
    if os.environ.get("MUJOCO_GL", "").lower().strip() in ("", "egl") and os.name == "posix":
        from mujoco.egl import GLContext

        return GLContext
    return mujoco.GLContext


def _scene_model(arm_xml: str, camera: Camera, scene: Scene, ball_radius: float) -> mujoco.MjModel:
    """Return the MuJoCo model of the arm, its surroundings, a ball and the camera."""
    root = ET.fromstring(arm_xml)
    for geom in root.iter("geom"):
        geom.set("rgba", xml_colour(_ARM_COLOUR))
    width, height = camera.size
    root.append(_element("statistic", extent=1.0))  # makes `near` and `far` distances in metres
    visual = _element("visual")
    visual.append(_element("map", znear=_NEAR, zfar=_FAR))
    visual.append(_element("global", offwidth=width, offheight=height))
    # Antialiasing is off: it blends nearby pixels and would shift small objects by half a pixel.
    visual.append(_element("quality", offsamples=0, numslices=48, numstacks=48))
    visual.append(_element("headlight", ambient=[0.45] * 3, diffuse=[0.25] * 3))
    root.append(visual)
    world = root.find("worldbody")
    assert world is not None
    world.append(_element("light", type="directional", dir=[0.3, 0.2, -1.0], diffuse=[0.5] * 3))

    def add(kind: str, colour: str, **numbers: Any) -> None:
        world.append(_element("geom", type=kind, rgba=xml_colour(colour), **numbers))

    floor = float(scene.floor)
    add("plane", GROUND_COLOUR, pos=[0.0, 0.0, floor], size=[20.0, 20.0, 1.0])
    for axis in range(2):
        for side in (-_WALLS, _WALLS):
            middle, half = [0.0, 0.0, floor + 0.5 * _HIGH], [_WALLS, _WALLS, 0.5 * _HIGH]
            middle[axis], half[axis] = side, 0.05
            add("box", _WALL, pos=middle, size=half)
    for ends, radius in zip(
        np.asarray(scene.capsule_ends), np.asarray(scene.capsule_radius), strict=True
    ):
        if radius >= 0.0:
            add("cylinder", _POLE, fromto=ends.reshape(-1), size=[radius])
    for ends, radius in zip(
        np.asarray(scene.beam_ends), np.asarray(scene.beam_radius), strict=True
    ):
        add("capsule", _STEEL, fromto=ends.reshape(-1), size=[radius])
    ball = _element("body", name="ball", mocap="true")
    ball.append(_element("geom", type="sphere", size=[ball_radius], rgba=xml_colour(_BALL)))
    world.append(ball)
    # MuJoCo's cameras look along -z with y up, the cameras of this library along z with y down.
    axes = np.asarray(camera.rotation, float)
    angle = np.rad2deg(2.0 * np.arctan(0.5 * height / float(camera.focal)))
    eye = {"pos": camera.position, "xyaxes": [*axes[:, 0], *-axes[:, 1]], "fovy": angle}
    world.append(_element("camera", name="eye", **eye))
    return mujoco.MjModel.from_xml_string(ET.tostring(root, "unicode"))


def _element(tag: str, **attributes: Any) -> ET.Element:
    written = {
        name: value if isinstance(value, str) else xml_numbers(*np.atleast_1d(value))
        for name, value in attributes.items()
    }
    return ET.Element(tag, written)
