r"""Where a camera stands, from pictures of a tagged object in the robot's hand.

With the hand at :math:`H_k` in the base, the marker at :math:`X` in the hand and at :math:`C_k` in
the camera, and the camera at :math:`Z` in the base, :math:`H_k X = Z C_k` for every pose. Two of
them give :math:`A X = X B` with :math:`A = H_j^{-1} H_i, B = C_j^{-1} C_i`, whose turns have equal
angles: that is solved linearly (Park and Martin, IEEE Transactions on Robotics and Automation,
1994). From there :math:`X` and :math:`Z` are moved until the marker's corners are seen where they
should be.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception.calibration import (
    CalibrationResiduals,
    TaggedObject,
    check_pose,
)
from contactgraph_franka.perception.camera import (
    Intrinsics,
    inverse,
    nearest_rotation,
    pose,
    rotation_of,
    rotation_vector,
)
from contactgraph_franka.perception.object_pose import ObjectPose

LEAST_POSES = 6
LEAST_TURN = 0.1
"""rad, root of the mean square, about the second axis. Less leaves where the marker is in the hand,
and with it the camera, to the noise."""
_SOFT = 1.0
"""px: corners farther off than that count less than squared."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """What `calibrate` found."""

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
    """Finds the camera's pose, and the marker's in the hand, together.

    ``hand_poses`` [K, 4, 4] take the hand's frame to the base's; ``sightings`` are how the camera
    saw ``marker`` at each of them. Where the marker sits in the hand need not be known, but it must
    not move there. Some 20 poses all over the workspace, turned by 20 degrees and more about two
    axes, are good. Raises `InvalidInputError` for fewer than six, for poses that are no rigid
    motions, and where the hand did not turn about two axes.
    """
    hands = _checked(hand_poses, sightings)
    hand_to_marker = _marker_start(hands, [each.pose for each in sightings])
    camera = _mean_pose(
        [
            hand @ hand_to_marker @ inverse(each.pose)
            for hand, each in zip(hands, sightings, strict=True)
        ]
    )
    problem = _Problem(hands, sightings, marker, intrinsics)
    everything = np.arange(len(hands))
    camera, hand_to_marker = problem.solved(camera, hand_to_marker, everything)
    left_out = [
        problem.apart(*problem.solved(camera, hand_to_marker, np.delete(everything, each)))[each]
        for each in everything
    ]
    off = problem.corners_apart(camera, hand_to_marker, everything)
    return HandEye(
        camera,
        hand_to_marker,
        CalibrationResiduals(
            poses=len(hands),
            pixel=float(np.sqrt((off**2).sum(axis=1).mean())),
            position=_rms(problem.apart(camera, hand_to_marker)),
            left_out=_rms(left_out),
            left_out_worst=float(max(left_out)),
        ),
    )


class _Problem:
    """All poses, and the corners of the marker as they were seen in each."""

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
        self._seen = [
            intrinsics.project(_moved(each.pose, points))
            for each, points in zip(sightings, self._points, strict=True)
        ]

    def solved(
        self, camera: np.ndarray, marker: np.ndarray, chosen: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Camera and marker that explain the ``chosen`` poses best, from a guess."""

        def residual(step: np.ndarray) -> np.ndarray:
            return self.corners_apart(*_stepped(camera, marker, step), chosen).ravel()

        found = least_squares(residual, np.zeros(12), loss="soft_l1", f_scale=_SOFT, x_scale="jac")
        return _stepped(camera, marker, found.x)

    def corners_apart(
        self, camera: np.ndarray, marker: np.ndarray, chosen: np.ndarray
    ) -> np.ndarray:
        """[P, 2] px: corners as they should be seen less as they are."""
        to_camera = inverse(camera)
        return np.concatenate(
            [
                self._intrinsics.project(
                    _moved(to_camera @ self._hands[each] @ marker, self._points[each])
                )
                - self._seen[each]
                for each in chosen
            ]
        )

    def apart(self, camera: np.ndarray, marker: np.ndarray) -> np.ndarray:
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
    turns = np.array(
        [rotation_vector(a[:3, :3].T @ b[:3, :3]) for a, b in itertools.combinations(hands, 2)]
    )
    second = float(np.linalg.svd(turns, compute_uv=False)[1] / np.sqrt(len(turns)))
    if second < LEAST_TURN:
        raise InvalidInputError(
            "a calibration needs turns of the hand about two axes: about the second one it turned "
            f"by {np.degrees(second):.1f} degrees on average, and must by "
            f"{np.degrees(LEAST_TURN):.0f}; tilt the hand to several sides between pictures"
        )
    return hands


def _marker_start(hands: np.ndarray, seen: Sequence[np.ndarray]) -> np.ndarray:
    """[4, 4]: the marker in the hand, from all pairs of poses."""
    pairs = [
        (inverse(hands[j]) @ hands[i], inverse(seen[j]) @ seen[i])
        for i, j in itertools.combinations(range(len(hands)), 2)
    ]
    # Turns are equal but for the frame they are told in: align their vectors.
    together = sum(
        np.outer(rotation_vector(a[:3, :3]), rotation_vector(b[:3, :3])) for a, b in pairs
    )
    turn = nearest_rotation(np.asarray(together))
    rows = np.concatenate([a[:3, :3] - np.eye(3) for a, _ in pairs])
    told = np.concatenate([turn @ b[:3, 3] - a[:3, 3] for a, b in pairs])
    return pose(turn, np.linalg.lstsq(rows, told, rcond=None)[0])


def _mean_pose(poses: Sequence[np.ndarray]) -> np.ndarray:
    mean = np.mean(poses, axis=0)
    return pose(nearest_rotation(mean[:3, :3]), mean[:3, 3])


def _stepped(
    camera: np.ndarray, marker: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Both poses after small turns and moves: [12] rad, m, rad, m."""
    return (
        pose(rotation_of(step[:3]) @ camera[:3, :3], camera[:3, 3] + step[3:6]),
        pose(rotation_of(step[6:9]) @ marker[:3, :3], marker[:3, 3] + step[9:]),
    )


def _moved(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ motion[:3, :3].T + motion[:3, 3]


def _rms(values: Sequence[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
