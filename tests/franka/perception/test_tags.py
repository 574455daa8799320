"""Tags that are drawn by their codes are read by the real detector, where they are."""

import numpy as np
import pytest
from drawn_tags import drawn, drawn_corners

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception.edges import find_edges

pytest.importorskip("pyapriltags", reason="the extra robot is not installed")
from contactgraph_franka.perception.tags import TagDetector


def test_drawn_tags_are_those_of_the_family():
    detector = TagDetector([range(587)])
    for first in (0, 6, 12, 18, 581):
        places = [(first + i, 10 + 100 * (i % 3), 20 + 110 * (i // 3)) for i in range(6)]
        found = {each.id: each for each in detector.detect(drawn(places))}
        assert sorted(found) == list(range(first, first + 6))
        for tag, column, row in places:
            off = found[tag].corners - drawn_corners(column, row)
            assert np.abs(off).max() < 0.3


def test_an_object_is_searched_around_its_last_position_and_then_elsewhere():
    detector = TagDetector([(3,), (5,)])
    for place in ((30, 40), (38, 44), (220, 150)):
        found = detector.detect(drawn([(3, *place), (5, 130, 20)]))
        assert sorted(each.id for each in found) == [3, 5]
        tag = next(each for each in found if each.id == 3)
        assert np.abs(tag.corners - drawn_corners(*place)).max() < 0.3


def test_only_tags_of_the_objects_are_returned():
    found = TagDetector([(5,)]).detect(drawn([(3, 30, 40), (5, 130, 20)]))
    assert [each.id for each in found] == [5]


def test_noise_gives_no_detections():
    noise = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    detector = TagDetector([range(587)])
    assert detector.detect(noise) == [] and detector.detect(noise) == []


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (np.zeros((4, 4, 3), np.uint8), r"found \(4, 4, 3\) uint8$"),
        (np.zeros((40, 40)), r"found \(40, 40\) float64$"),
    ],
)
def test_a_picture_must_be_grey(image, said):
    with pytest.raises(InvalidInputError, match=said):
        TagDetector([(0,)]).detect(image)


def test_edges_are_accurate_to_hundredths_of_a_pixel():
    exact = drawn_corners(100, 70)
    rough = exact + np.random.default_rng(1).uniform(-1.5, 1.5, (4, 2))
    edges = find_edges(drawn([(3, 100, 70)]), rough[None])
    assert edges.found.all()
    ways = np.roll(exact, -1, axis=0) - exact
    across = np.stack([ways[:, 1], -ways[:, 0]], axis=1) / np.linalg.norm(ways, axis=1)[:, None]
    off = np.einsum("ekc,ec->ek", edges.ends - exact[:, None], across)
    assert np.abs(off).max() < 0.02


def test_absent_edges_are_not_detected():
    corners = drawn_corners(100, 70)
    assert not find_edges(drawn([]), corners[None]).found.any()
    for hidden_to in (128, 140):  # half of the upper and the lower edge, or most
        hidden = drawn([(3, 100, 70)])
        hidden[60:140, 90:hidden_to] = 60
        assert find_edges(hidden, corners[None]).found.tolist() == [False, True, False, False]
    assert not find_edges(drawn([(3, 100, 70)]), corners[None] - 99.0).found.any()
