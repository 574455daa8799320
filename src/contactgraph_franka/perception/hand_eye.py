r"""Calibration of a fixed camera from pictures of a tagged object in the robot's hand.

With the hand at $H_k$ in the base, the marker at $X$ in the hand and at $C_k$ in
the camera, and the camera at $Z$ in the base, $H_k X = Z C_k$ for every pose. Two of
them give $A X = X B$ with $A = H_j^{-1} H_i, B = C_j^{-1} C_i$, solved linearly (Park
and Martin, IEEE Transactions on Robotics and Automation, 1994). Then the reprojection error of the
marker's corners is minimised over $X$ and $Z$.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception.calibration import CalibrationResiduals, TaggedObject
from contactgraph_franka.perception.camera import (
    Intrinsics,
    check_pose,
    nearest_rotation,
    perturbed,
    pose,
    transform,
)
from contactgraph_franka.perception.object_pose import ObjectPose

LEAST_POSES = 6
LEAST_TURN = 0.1
"""Least root mean square turn about the second axis, rad. Less leaves the marker's position in the
hand, and with it the camera's, to the noise."""
_SOFT = 1.0  # px; larger errors count linearly


@dataclass(frozen=True, eq=False)
class HandEye:
    """Result of `calibrate`."""

    camera_pose: np.ndarray
    """[4, 4]: camera to the robot's base."""
    marker_pose: np.ndarray
    """[4, 4]: the marker's frame to the hand's."""
    residuals: CalibrationResiduals


def calibrate(
    hand_poses: np.ndarray,
    sightings: Sequence[ObjectPose],
    marker: TaggedObject,
    intrinsics: Intrinsics,
) -> HandEye:
    """Estimates the pose of the camera and that of the marker in the hand.

    ``hand_poses`` [K, 4, 4] take the hand's frame to the base's; ``sightings`` are the poses of
    ``marker`` in the camera at each of them. The marker must not move in the hand. About 20 poses
    all over the workspace, turned by at least 20 degrees about two axes, are good. Raises
    `InvalidInputError` for fewer than six poses, for poses that are no rigid motions, and for turns
    about one axis only.
    """
    hands = _checked(hand_poses, sightings)
    markers = np.stack([each.pose for each in sightings])
    marker_pose = _initial_marker(hands, markers)
    mean = np.mean(hands @ marker_pose @ np.linalg.inv(markers), axis=0)
    camera = pose(nearest_rotation(mean[:3, :3]), mean[:3, 3])
    problem = _Problem(hands, sightings, marker, intrinsics)
    everything = np.arange(len(hands))
    camera, marker_pose = problem.solve(camera, marker_pose, everything)
    subsets = (np.delete(everything, each) for each in everything)
    others = [problem.solve(camera, marker_pose, subset) for subset in subsets]
    left_out = np.array([problem.distances(*one)[each] for each, one in enumerate(others)])
    pixels = problem.reprojection_errors(camera, marker_pose, everything)
    positions = problem.distances(camera, marker_pose)
    residuals = CalibrationResiduals(
        poses=len(hands),
        pixel=float(np.sqrt((pixels**2).sum(axis=1).mean())),
        position=float(np.sqrt(np.mean(positions**2))),
        left_out=float(np.sqrt(np.mean(left_out**2))),
        left_out_worst=float(left_out.max()),
    )
    return HandEye(camera, marker_pose, residuals)


class _Problem:
    """All poses, and the observed corners of the marker in each."""

    def __init__(
        self,
        hands: np.ndarray,
        sightings: Sequence[ObjectPose],
        marker: TaggedObject,
        intrinsics: Intrinsics,
    ) -> None:
        self._hands, self._sightings, self._intrinsics = hands, sightings, intrinsics
        tags = marker.by_id
        for number, each in enumerate(sightings):
            if not set(each.tags) <= set(tags):
                raise InvalidInputError(f"sighting {number} is of other tags than the marker's")
        self._points = [np.concatenate([tags[tag].corners for tag in s.tags]) for s in sightings]
        self._observed = [
            intrinsics.project(transform(each.pose, points))
            for each, points in zip(sightings, self._points, strict=True)
        ]

    def solve(
        self, camera: np.ndarray, marker: np.ndarray, chosen: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Camera and marker that explain the ``chosen`` poses best, from an initial guess."""

        def moved(step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return perturbed(camera, step[:6]), perturbed(marker, step[6:])

        solution = least_squares(
            lambda step: self.reprojection_errors(*moved(step), chosen).ravel(),
            np.zeros(12),
            loss="soft_l1",
            f_scale=_SOFT,
            x_scale="jac",
        )
        return moved(solution.x)

    def reprojection_errors(
        self, camera: np.ndarray, marker: np.ndarray, chosen: np.ndarray
    ) -> np.ndarray:
        """[P, 2] px: predicted less observed corners."""
        to_camera = np.linalg.inv(camera)
        return np.concatenate(
            [
                self._intrinsics.project(
                    transform(to_camera @ self._hands[each] @ marker, self._points[each])
                )
                - self._observed[each]
                for each in chosen
            ]
        )

    def distances(self, camera: np.ndarray, marker: np.ndarray) -> np.ndarray:
        """[K] m: between the marker's positions by camera and by hand."""
        by_camera = np.array([(camera @ each.pose)[:3, 3] for each in self._sightings])
        return np.linalg.norm(by_camera - (self._hands @ marker)[:, :3, 3], axis=1)


def _checked(hand_poses: np.ndarray, sightings: Sequence[ObjectPose]) -> np.ndarray:
    hands = np.asarray(hand_poses, dtype=np.float64)
    if hands.shape != (len(sightings), 4, 4):
        raise InvalidInputError(
            f"hand_poses must be [K, 4, 4], as many as sightings ({len(sightings)}), "
            f"found {hands.shape}"
        )
    if len(hands) < LEAST_POSES:
        raise InvalidInputError(
            f"a calibration needs at least {LEAST_POSES} poses of the hand, found {len(hands)}"
        )
    for number, each in enumerate(hands):
        check_pose(f"hand pose {number}", each)
    turns = _rotation_vectors(_between_pairs(hands))
    second = float(np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns)))
    if second < LEAST_TURN:
        raise InvalidInputError(
            "a calibration needs turns of the hand about two axes: about the second one it turned "
            f"by {np.degrees(second):.1f} degrees on average, and must by "
            f"{np.degrees(LEAST_TURN):.0f}; tilt the hand to several sides between pictures"
        )
    return hands


def _initial_marker(hands: np.ndarray, markers: np.ndarray) -> np.ndarray:
    """[4, 4]: the marker in the hand, from all pairs of poses."""
    a, b = _between_pairs(hands), _between_pairs(markers)
    # A and B turn by the same angle; X aligns their rotation vectors.
    turn = Rotation.align_vectors(_rotation_vectors(a), _rotation_vectors(b))[0].as_matrix()
    rows = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (b[:, :3, 3] @ turn.T - a[:, :3, 3]).ravel()
    return pose(turn, np.linalg.lstsq(rows, right, rcond=None)[0])


def _between_pairs(poses: np.ndarray) -> np.ndarray:
    """[P, 4, 4]: from each of ``poses`` [K, 4, 4] to each later one."""
    first, second = np.triu_indices(len(poses), 1)
    return np.linalg.inv(poses[second]) @ poses[first]


def _rotation_vectors(poses: np.ndarray) -> np.ndarray:
    """[P, 3] rad."""
    return Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
