"""Finding AprilTags in a picture. The one module that imports pyapriltags."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from contactgraph.data import InvalidInputError

try:
    import pyapriltags
except ModuleNotFoundError as error:
    raise InvalidInputError(
        "finding tags needs pyapriltags: pip install 'contactgraph[robot]'"
    ) from error

_CENTRE = 0.5
"""px: the library counts from a pixel's edge, `Intrinsics` from its centre."""
_COARSE = (1.5, 1.0)
"""By how much the picture is made smaller where all of it is searched, from one frame in which an
object is lost to the next. The first is 4 times as fast; the second finds what it overlooks."""
_LARGER, _FINE = 2, 1.5
"""By how much a window is made larger, and smaller again by the library where it looks for squares.
Between tag and edge of a block are few pixels, which the library's tiles of 4 px run together."""
_SHARPENING = 0.25
"""The library's own default, which its wrapper rounds to zero."""
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
    at a lower resolution, since that takes more than a hundred milliseconds otherwise; what is
    found is then looked at again in its window, enlarged.
    """

    def __init__(self, objects: Iterable[Sequence[int]]) -> None:
        self._objects = [frozenset(ids) for ids in objects]
        self._windows: list[Window | None] = [None] * len(self._objects)
        self._fine = _detector(_FINE)
        self._coarse = [_detector(smaller) for smaller in _COARSE]
        self._searches = 0

    def detect(self, image: np.ndarray) -> list[TagDetection]:
        """The tags of the objects in ``image`` [H, W] uint8, each at most once.

        Raises `InvalidInputError` for another kind of picture.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise InvalidInputError(
                f"image must be [H, W] uint8 (grey), found {image.shape} {image.dtype}"
            )
        found = [
            self._in_window(image, window, ids)
            for window, ids in zip(self._windows, self._objects, strict=True)
        ]
        if all(found):
            self._searches = 0
        else:
            self._search(image, found)
        self._windows = [_around(each, image) for each in found]
        return [each for some in found for each in some]

    def _search(self, image: np.ndarray, found: list[list[TagDetection]]) -> None:
        """Looks for what is not yet ``found`` in all of the picture."""
        everywhere = _detected(self._coarse[self._searches % len(_COARSE)], image)
        self._searches += 1
        for index, ids in enumerate(self._objects):
            if not found[index]:
                coarse = _best(everywhere, ids)
                found[index] = self._in_window(image, _around(coarse, image), ids) or coarse

    def _in_window(
        self, image: np.ndarray, window: Window | None, ids: frozenset[int]
    ) -> list[TagDetection]:
        if window is None:
            return []
        part = image[window.top : window.bottom, window.left : window.right]
        height, width = part.shape
        larger = Image.fromarray(part).resize(
            (_LARGER * width, _LARGER * height), Image.Resampling.BICUBIC
        )
        seen = _detected(self._fine, np.asarray(larger), _LARGER, window.left, window.top)
        return _best(seen, ids)


def _detector(smaller: float) -> "pyapriltags.Detector":
    made = pyapriltags.Detector("tag36h11", quad_decimate=smaller)
    settings = made.tag_detector_ptr
    assert settings is not None
    settings.contents.decode_sharpening = _SHARPENING
    return made


def _detected(
    detector: "pyapriltags.Detector",
    image: np.ndarray,
    larger: int = 1,
    left: int = 0,
    top: int = 0,
) -> list[TagDetection]:
    """The tags in part of a picture, which was made ``larger``."""
    origin = np.array([left - _CENTRE, top - _CENTRE])
    return [
        TagDetection(int(each.tag_id), each.corners / larger + origin, float(each.decision_margin))
        for each in detector.detect(image)
        if each.decision_margin >= _LEAST_MARGIN
    ]


def _best(seen: Sequence[TagDetection], ids: frozenset[int]) -> list[TagDetection]:
    """Of each of the ``ids`` the surest detection."""
    best: dict[int, TagDetection] = {}
    for each in seen:
        if each.id in ids and (each.id not in best or each.margin > best[each.id].margin):
            best[each.id] = each
    return list(best.values())


def _around(seen: Sequence[TagDetection], image: np.ndarray) -> Window | None:
    """Where to look for these next; None where there are none."""
    if not seen:
        return None
    corners = np.concatenate([each.corners for each in seen])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = max(_LEAST_MARGIN_OF_WINDOW, _MARGIN_OF_WINDOW * float((high - low).max()))
    height, width = image.shape
    left, top = np.floor(np.maximum(low - margin, 0)).astype(int).tolist()
    right, bottom = np.ceil(np.minimum(high + margin, (width, height))).astype(int).tolist()
    return Window(left, top, right, bottom)
