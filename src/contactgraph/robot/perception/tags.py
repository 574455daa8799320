"""Finding AprilTags in a picture. The one module that imports pyapriltags."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError

try:
    import pyapriltags
except ModuleNotFoundError as error:
    raise InvalidInputError(
        "finding tags needs pyapriltags: pip install 'contactgraph[robot]'"
    ) from error

_CENTRE = 0.5
"""px: the library counts from a pixel's edge, `Intrinsics` from its centre."""
_COARSE = 2.0
"""By how much the picture is made smaller where all of it is searched: 4 times as fast."""
_LEAST_MARGIN = 20.0
"""Of a detection's decision. In pictures without tags false ones stay below, true ones of 20 px
and more are above."""
_MARGIN_OF_WINDOW = 0.6
"""By what share of its own size a window is wider than what was seen, on each side."""
_LEAST_MARGIN_OF_WINDOW = 24
"""px. At 1 m and 900 px focal length, what moves at 0.8 m/s goes that far in 1/30 s."""


@dataclass(frozen=True, eq=False)
class TagDetection:
    """A tag36h11 in a picture. Its pose needs its size, which `TaggedObject` knows."""

    id: int
    corners: np.ndarray
    """[4, 2] px, as in the picture: lower left, lower right, upper right, upper left of the tag as
    one reads it. Pixel centres are whole numbers."""
    margin: float
    """Of the decision between black and white, in grey levels: above 20, the larger the surer."""


@dataclass(frozen=True)
class Window:
    """Part of a picture: columns from `left` to before `right`, rows from `top` to `bottom`."""

    left: int
    top: int
    right: int
    bottom: int


class TagDetector:
    """Finds tags, in windows where they were last seen, and in all of the picture where not.

    ``objects`` are the ids that move together, as one object's do. All of the picture is searched
    at half its resolution, since that takes a hundred milliseconds otherwise; what is found is then
    looked at again in its window, in full.
    """

    def __init__(self, objects: Iterable[Sequence[int]]) -> None:
        self._objects = [frozenset(ids) for ids in objects]
        self._windows: list[Window | None] = [None] * len(self._objects)
        self._fine = pyapriltags.Detector("tag36h11", quad_decimate=1.0)
        self._coarse = pyapriltags.Detector("tag36h11", quad_decimate=_COARSE)

    def detect(self, image: np.ndarray) -> list[TagDetection]:
        """The tags of the objects in ``image`` [H, W] uint8, each at most once.

        Raises `InvalidInputError` for another kind of picture.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise InvalidInputError(
                f"image must be [H, W] uint8 (grey), found {image.shape} {image.dtype}"
            )
        found: list[list[TagDetection]] = [[] for _ in self._objects]
        for index, ids in enumerate(self._objects):
            found[index] = self._in_window(image, self._windows[index], ids)
        if not all(found):
            everywhere = _detected(self._coarse, image, 0, 0)
            for index, ids in enumerate(self._objects):
                if not found[index]:
                    window = _around([each for each in everywhere if each.id in ids], image)
                    found[index] = self._in_window(image, window, ids)
        self._windows = [_around(each, image) for each in found]
        return [each for some in found for each in some]

    def _in_window(
        self, image: np.ndarray, window: Window | None, ids: frozenset[int]
    ) -> list[TagDetection]:
        if window is None:
            return []
        part = image[window.top : window.bottom, window.left : window.right]
        seen = _detected(self._fine, part, window.left, window.top)
        best: dict[int, TagDetection] = {}
        for each in seen:
            if each.id in ids and (each.id not in best or each.margin > best[each.id].margin):
                best[each.id] = each
        return list(best.values())


def _detected(
    detector: "pyapriltags.Detector", image: np.ndarray, left: int, top: int
) -> list[TagDetection]:
    return [
        TagDetection(
            int(each.tag_id),
            each.corners + np.array([left - _CENTRE, top - _CENTRE]),
            float(each.decision_margin),
        )
        for each in detector.detect(image)
        if each.decision_margin >= _LEAST_MARGIN
    ]


def _around(seen: Sequence[TagDetection], image: np.ndarray) -> Window | None:
    """Where to look for these next; None where there are none."""
    if not seen:
        return None
    corners = np.concatenate([each.corners for each in seen])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = max(_LEAST_MARGIN_OF_WINDOW, _MARGIN_OF_WINDOW * float((high - low).max()))
    height, width = image.shape
    left, top = np.clip(np.floor(low - margin), 0, (width - 1, height - 1)).astype(int)
    right, bottom = np.clip(np.ceil(high + margin), (left + 1, top + 1), (width, height)).astype(
        int
    )
    return Window(int(left), int(top), int(right), int(bottom))
