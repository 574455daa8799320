"""Poses from corners that were projected exactly, and from noisy ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception import Intrinsics, Tag, TaggedObject, single_tag
from contactgraph_franka.perception.camera import pose, rotation_of
from contactgraph_franka.perception.detector import DEPTH_NOISE, with_depth

pytest.importorskip("pyapriltags", reason="the extra robot is not installed")
from contactgraph_franka.perception.object_pose import object_poses
from contactgraph_franka.perception.tags import TagDetection

STRAIGHT = Intrinsics(900.0, 905.0, 640.0, 355.0, 1280, 720)
BENT = Intrinsics(900.0, 905.0, 640.0, 355.0, 1280, 720, (0.08, -0.1, 0.001, -0.002, 0.02))
DOWN = rotation_of(np.array([np.pi, 0.0, 0.0]))
"""A tag that lies in the picture as one reads it: its y up, its z to the reader."""


def box():
    """A cube of 0.06 m with tags 0 to 2 on three of its sides."""
    turns = ([0.0, 0.0, 0.0], [0.0, np.pi / 2, 0.0], [-np.pi / 2, 0.0, 0.0])
    tags = []
    for number, turn in enumerate(turns):
        rotation = rotation_of(np.array(turn))
        tags.append(Tag(number, 0.04, pose(rotation, rotation @ [0.0, 0.0, 0.03])))
    return TaggedObject(tuple(tags))


def detected(tagged, place, lens, rng=None, noise=0.0):
    """Detections of all tags, whether or not they face the camera."""
    found = []
    for tag in tagged.tags:
        corners = lens.project(tag.corners @ place[:3, :3].T + place[:3, 3])
        if rng is not None:
            corners = corners + rng.normal(0.0, noise, (4, 2))
        found.append(TagDetection(tag.id, corners, 50.0))
    return found


def anywhere(rng):
    turn = rotation_of(rng.normal(0.0, 0.4, 3)) @ DOWN @ rotation_of(np.array([0.0, -0.5, 0.5]))
    return pose(turn, np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.6, 1.2)]))


@pytest.mark.parametrize("lens", [STRAIGHT, BENT], ids=["straight", "bent"])
@pytest.mark.parametrize("tagged", [box(), single_tag(7, 0.05)], ids=["box", "tag"])
def test_exact_corners_give_the_exact_pose(tagged, lens):
    rng = np.random.default_rng(0)
    for _ in range(20):
        place = anywhere(rng)
        best, *others = object_poses(detected(tagged, place, lens), tagged, lens)
        np.testing.assert_allclose(best.pose, place, atol=1e-6)
        assert best.tags == tuple(tagged.by_id) and best.error < 1e-3
        # Tags on several sides leave one pose.
        assert not others or len(tagged.tags) == 1


def test_the_covariance_is_that_of_the_errors():
    rng, tagged = np.random.default_rng(1), box()
    distances = []
    for _ in range(150):
        place = anywhere(rng)
        best, *_ = object_poses(detected(tagged, place, STRAIGHT, rng, 0.3), tagged, STRAIGHT, 0.3)
        turn = Rotation.from_matrix(place[:3, :3] @ best.pose[:3, :3].T).as_rotvec()
        error = np.concatenate([turn, place[:3, 3] - best.pose[:3, 3]])
        distances.append(error @ np.linalg.solve(best.covariance, error))
    # Inflated by the fit's error where that is above 1, hence below 6.
    assert 4.0 < np.mean(distances) < 6.5


def test_a_lone_tag_far_away_leaves_two_poses_and_one_is_right():
    tagged, rng, two = single_tag(7, 0.03), np.random.default_rng(2), 0
    for _ in range(30):
        place = pose(rotation_of(rng.normal(0.0, 0.3, 3)) @ DOWN, np.array([0.1, -0.1, 1.2]))
        likely = object_poses(detected(tagged, place, STRAIGHT, rng, 0.15), tagged, STRAIGHT)
        two += len(likely) == 2
        apart = [
            Rotation.from_matrix(place[:3, :3].T @ each.pose[:3, :3]).magnitude() for each in likely
        ]
        assert min(apart) < 0.35
    assert two > 15


def test_one_corner_that_is_far_off_hardly_counts():
    tagged, place = box(), anywhere(np.random.default_rng(3))
    detections = detected(tagged, place, STRAIGHT)
    detections[1].corners[2] += (6.0, -4.0)
    best, *_ = object_poses(detections, tagged, STRAIGHT)
    assert np.linalg.norm(best.pose[:3, 3] - place[:3, 3]) < 2e-3
    assert best.explained < 24


def test_tags_of_others_are_none_of_its_own():
    others = detected(single_tag(9, 0.05), anywhere(np.random.default_rng(0)), STRAIGHT)
    assert object_poses(others, box(), STRAIGHT) == []


def plane_depth(tagged, place, shape):
    """[H, W] m of the plane of a single tag."""
    columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    rays = STRAIGHT.rays(np.stack([columns, rows], axis=-1).astype(float))
    normal = place[:3, 2]
    return ((normal @ place[:3, 3]) / (rays @ normal[:2] + normal[2])).astype(np.float32)


def test_depth_moves_the_pose_by_as_much_as_it_is_surer():
    tagged, rng = single_tag(7, 0.04), np.random.default_rng(4)
    place = pose(rotation_of(np.array([0.4, -0.3, 0.1])) @ DOWN, np.array([0.05, 0.0, 1.0]))
    best, *_ = object_poses(detected(tagged, place, STRAIGHT), tagged, STRAIGHT)
    wrong = pose(best.pose[:3, :3], best.pose[:3, 3] + [0.0, 0.0, 0.01])
    off = type(best)(wrong, best.covariance, best.tags, best.error, best.explained)
    depth = plane_depth(tagged, place, (720, 1280))
    holes = rng.random(depth.shape) < 0.6
    depth[holes] = 0.0
    corrected = with_depth(off, depth, tagged, STRAIGHT)
    before, noise = best.covariance[5, 5], (DEPTH_NOISE * 1.01**2) ** 2
    left = 0.01 * noise / (before + noise)
    assert corrected.pose[2, 3] - 1.0 == pytest.approx(left, abs=3e-4)
    assert corrected.covariance[5, 5] == pytest.approx(before * noise / (before + noise), rel=0.1)


def test_depth_of_something_else_or_none_changes_nothing():
    tagged = single_tag(7, 0.04)
    place = pose(DOWN, np.array([0.0, 0.0, 1.0]))
    best, *_ = object_poses(detected(tagged, place, STRAIGHT), tagged, STRAIGHT)
    for depth in (0.0, np.nan, 0.5):
        assert with_depth(best, np.full((720, 1280), depth, np.float32), tagged, STRAIGHT) is best


def test_a_lens_bends_and_straightens():
    pixels = np.stack(np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 719, 7)), axis=-1)
    rays = BENT.rays(pixels)
    points = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1)
    np.testing.assert_allclose(BENT.project(2.5 * points), pixels, atol=1e-3)
    assert np.abs(BENT.rays(pixels) - STRAIGHT.rays(pixels)).max() > 0.01


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Tag(0, 0.1, np.diag([1.0, 1, -1, 1])), "pose of tag 0 must be a rotation and"),
        (lambda: Tag(0, 0.1, np.eye(3)), r"pose of tag 0 must be \[4, 4\] finite numbers"),
        (lambda: TaggedObject(single_tag(1, 0.1).tags * 2), r"with different ids, found \[1, 1\]"),
        (lambda: Intrinsics(9.0, 9.0, np.nan, 0.0, 64, 48), "cx, cy must be finite px"),
        (lambda: Intrinsics(9.0, 9.0, 1.0, 0.0, 64, 48, (0.1,)), "distortion must be 5 finite"),
    ],
)
def test_impossible_values_are_refused(make, said):
    with pytest.raises(InvalidInputError, match=said):
        make()
