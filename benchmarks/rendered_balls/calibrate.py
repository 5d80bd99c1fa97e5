"""Hand-eye calibration of a fixed camera beside a robot, on the host, in float64.

The robot holds a board of known points before the camera, which does not move. In view k, A_k is
the pose of the flange in the robot's base frame, and B_k the pose of the board in the camera's
frame. In all views, Z is the pose of the board on the flange, and X the pose of the camera in the
base frame. They satisfy  A_k Z = X B_k.  Two views j and k eliminate Z:
(A_j A_k^-1) X = X (B_j B_k^-1),  the equation A X = X B of the literature. It is solved in closed
form, and then refined on the measured points. Poses are (4, 4) matrices, lengths are in metres.
"""

import dataclasses

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

_LEAST_TURN = 0.05  # [rad], least rotation between two views whose equation A X = X B is used


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The poses of camera and board that a calibration found, and how well they fit the views."""

    camera: np.ndarray  # (4, 4), pose of the camera in the robot's base frame
    board: np.ndarray  # (4, 4), pose of the board on the flange
    residual: float  # root mean square distance of measured points, in standard deviations


def pose(rotation: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return pose matrices (..., 4, 4) of rotations (..., 3, 3) and positions (..., 3) [m]."""
    found = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    found[..., :3, :3], found[..., :3, 3], found[..., 3, 3] = rotation, place, 1.0
    return found


def rigid_motion(points: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) that maps M points (M, 3) [m] onto measured points (M, 3) [m].

    The pose minimises the sum of squared distances in closed form, by a singular value
    decomposition [Kabsch1976]. The result is never a reflection.

    Raises:
        ValueError: there are fewer than three points, or all points lie on one line.
    """
    points, seen = np.asarray(points, float), np.asarray(seen, float)
    if points.shape != seen.shape or points.ndim != 2 or points.shape[1] != 3 or len(points) < 3:
        raise ValueError(
            f"points and seen must both be (M, 3) with M >= 3, got {points.shape} and {seen.shape}"
        )
    middles = points.mean(axis=0), seen.mean(axis=0)
    U, singular, V = np.linalg.svd((seen - middles[1]).T @ (points - middles[0]))
    if not singular[1] > 1e-9 * max(singular[0], 1e-300):
        raise ValueError("points must not lie on one line")
    proper = np.diag([1.0, 1.0, np.linalg.det(U @ V)])
    rotation = U @ proper @ V
    return pose(rotation, middles[1] - rotation @ middles[0])


def hand_eye(flange: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Return the pose X (4, 4) of the camera that solves A X = X B for every pair of views.

    A is the motion of the flange between the two views, and B the motion of the board in the
    camera's frame. The rotation of X best maps the rotation vectors of all B onto the rotation
    vectors of all A [Park1994]. The position then follows from linear least squares.

    Args:
        flange: (K, 4, 4), poses of the flange in the robot's base frame in K >= 3 views.
        views: (K, 4, 4), poses of the board in the camera's frame in the same views.

    Raises:
        ValueError: there are too few views, or all views rotate about one axis, so that the
            camera's position along that axis is undetermined.
    """
    flange, views = np.asarray(flange, float), np.asarray(views, float)
    if flange.shape != views.shape or flange.shape[1:] != (4, 4):
        raise ValueError(
            f"flange and views must be (K, 4, 4) each, got {flange.shape} and {views.shape}"
        )
    first, second = np.triu_indices(len(flange), 1)
    A = flange[second] @ np.linalg.inv(flange[first])
    B = views[second] @ np.linalg.inv(views[first])
    turns = [Rotation.from_matrix(each[:, :3, :3]).as_rotvec() for each in (A, B)]
    counts = np.minimum(*(np.linalg.norm(each, axis=1) for each in turns)) > _LEAST_TURN
    A, B, (a, b) = A[counts], B[counts], (each[counts] for each in turns)
    U, singular, V = np.linalg.svd(a.T @ b)
    if len(a) < 2 or not singular[1] > 1e-3 * singular[0]:
        raise ValueError(
            f"views must be three or more that turn about different axes, got {len(flange)}"
        )
    rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    system = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (np.einsum("ij,kj->ki", rotation, B[:, :3, 3]) - A[:, :3, 3]).reshape(-1)
    return pose(rotation, np.linalg.lstsq(system, right, rcond=None)[0])


def calibrate(
    flange: np.ndarray, points: np.ndarray, seen: np.ndarray, std: np.ndarray | float = 1.0
) -> Calibration:
    """Return the poses of the camera and the board from views of a board that the robot holds.

    `rigid_motion` gives the board's pose in each view, and `hand_eye` the camera's pose from all
    views. Levenberg-Marquardt then refines both poses together: it minimises the distances between
    measured and expected points, each in units of its standard deviation.

    Args:
        flange: (K, 4, 4), poses of the flange in the base frame in K >= 3 views.
        points: (M, 3) [m], M >= 3 points of the board in its own frame.
        seen: (K, M, 3) [m], the measured points in the camera's frame.
        std: [m], standard deviations of the measured points: one number, or (K, M, 3) along the
            camera's axes.

    Raises:
        ValueError: there are fewer than three points or views, all points lie on one line, or all
            views rotate about one axis.
    """
    flange, points, seen = (np.asarray(each, float) for each in (flange, points, seen))
    views = np.stack([rigid_motion(points, each) for each in seen])
    camera = hand_eye(flange, views)
    # The board does not move on the flange. The initial guess of its pose is the mean of all views.
    boards = np.linalg.inv(flange) @ camera @ views
    turn = Rotation.from_matrix(boards[:, :3, :3]).mean().as_matrix()
    board = pose(turn, boards[:, :3, 3].mean(axis=0))

    def apply_change(change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turns = Rotation.from_rotvec(change[:6].reshape(2, 3)).as_matrix()
        there = pose(turns, change[6:].reshape(2, 3))
        return camera @ there[0], board @ there[1]

    def errors(change: np.ndarray) -> np.ndarray:
        at, held = apply_change(change)
        to_camera = np.linalg.inv(at) @ flange @ held
        expected = points @ np.swapaxes(to_camera[:, :3, :3], 1, 2) + to_camera[:, None, :3, 3]
        return ((expected - seen) / std).reshape(-1)

    refined = least_squares(errors, np.zeros(12), method="lm", x_scale="jac")
    camera, board = apply_change(refined.x)
    free = max(seen.size - 12, 1)
    return Calibration(camera, board, float(np.sqrt(2.0 * refined.cost / free)))
