"""AprilTag detection in pictures. No other module imports pyapriltags."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from PIL import Image

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception.camera import Window
from contactgraph_franka.perception.edges import CELLS

try:
    import pyapriltags
except ModuleNotFoundError as error:
    raise InvalidInputError(
        "finding tags needs pyapriltags: pip install 'contactgraph[robot]'"
    ) from error

_CENTRE = 0.5  # px; the library counts from a pixel's edge, `Intrinsics` from its centre
_DECIMATION = (1.5, 1.0)
"""Reductions of a full frame, in turn while an object is lost. The first is 4 times as fast, the
second finds smaller tags."""
_ENLARGEMENT, _WINDOW_DECIMATION = 2, 1.5
"""Enlargement of a window and reduction inside the library. Few pixels lie between tag and edge of
a block, and the library's tiles of 4 px would merge them."""
_SHARPENING = 0.25  # The library's own default, which its wrapper rounds to zero
_LEAST_MARGIN = 20.0
"""Least decision margin. False detections stay below; true ones of 20 px and more are above."""
_WINDOW_MARGIN = 0.6  # Margin of a window on each side over the size of the detections
_LEAST_WINDOW_MARGIN = 24
"""px. At 1 m and 900 px focal length, motion at 0.8 m/s covers it in 1/30 s."""


@dataclass(frozen=True, eq=False)
class TagDetection:
    """A tag36h11 in a picture."""

    id: int
    corners: np.ndarray
    """[4, 2] px: lower left, lower right, upper right, upper left of the tag as printed, with pixel
    centres at integers."""
    margin: float
    """Decision margin between black and white, grey levels; at least 20."""


class TagDetector:
    """Detects tags in windows around their last positions, and in the full frame otherwise.

    ``objects`` are groups of ids that move together. A full search takes more than a hundred
    milliseconds, so it runs at a lower resolution; its detections are refined in windows.
    """

    def __init__(self, objects: Iterable[Sequence[int]]) -> None:
        self._objects = [frozenset(ids) for ids in objects]
        self._windows: list[Window | None] = [None] * len(self._objects)
        self._fine = _detector(_WINDOW_DECIMATION)
        self._coarse = [_detector(decimation) for decimation in _DECIMATION]
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
        self._windows = [_window(each, image) for each in found]
        return [each for group in found for each in group]

    def _search(self, image: np.ndarray, found: list[list[TagDetection]]) -> None:
        """Searches the full frame for the objects missing in ``found``."""
        everywhere = _detected(self._coarse[self._searches % len(_DECIMATION)], image)
        self._searches += 1
        for index, ids in enumerate(self._objects):
            if not found[index]:
                coarse = _best(everywhere, ids)
                found[index] = self._in_window(image, _window(coarse, image), ids) or coarse

    def _in_window(
        self, image: np.ndarray, window: Window | None, ids: frozenset[int]
    ) -> list[TagDetection]:
        if window is None:
            return []
        enlarged = Image.fromarray(image[window.rows, window.columns]).resize(
            (_ENLARGEMENT * window.width, _ENLARGEMENT * window.height), Image.Resampling.BICUBIC
        )
        detections = _detected(
            self._fine, np.asarray(enlarged), _ENLARGEMENT, window.left, window.top
        )
        return _best(detections, ids)


def _detector(decimation: float) -> "pyapriltags.Detector":
    detector = pyapriltags.Detector("tag36h11", quad_decimate=decimation)
    settings = detector.tag_detector_ptr
    assert settings is not None
    settings.contents.decode_sharpening = _SHARPENING
    return detector


def _detected(
    detector: "pyapriltags.Detector",
    image: np.ndarray,
    enlargement: int = 1,
    left: int = 0,
    top: int = 0,
) -> list[TagDetection]:
    """The tags in an enlarged part of a picture, in the picture's pixels."""
    origin = np.array([left - _CENTRE, top - _CENTRE])
    return [
        TagDetection(
            int(each.tag_id), each.corners / enlargement + origin, float(each.decision_margin)
        )
        for each in detector.detect(image)
        if each.decision_margin >= _LEAST_MARGIN
    ]


def _best(detections: Sequence[TagDetection], ids: frozenset[int]) -> list[TagDetection]:
    """The detection of each of the ``ids`` with the largest margin."""
    best: dict[int, TagDetection] = {}
    for each in detections:
        if each.id in ids and (each.id not in best or each.margin > best[each.id].margin):
            best[each.id] = each
    return list(best.values())


def _window(detections: Sequence[TagDetection], image: np.ndarray) -> Window | None:
    """The window of the next search; None without detections."""
    if not detections:
        return None
    corners = np.concatenate([each.corners for each in detections])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = max(_LEAST_WINDOW_MARGIN, _WINDOW_MARGIN * float((high - low).max()))
    height, width = image.shape
    left, top = np.floor(np.maximum(low - margin, 0)).astype(int).tolist()
    right, bottom = np.ceil(np.minimum(high + margin, (width, height))).astype(int).tolist()
    return Window(left, top, right - left, bottom - top)


def black_cells(tag: int) -> np.ndarray:
    """[8, 8] bool, rows from the top: the black cells of tag36h11 number ``tag``, 0 to 586."""
    code, columns, rows = _family()
    black = np.ones((CELLS, CELLS), bool)
    bits = len(columns)
    for bit, (column, row) in enumerate(zip(columns, rows, strict=True)):
        black[row, column] = not code[tag] >> (bits - 1 - bit) & 1
    return black


@cache
def _family() -> tuple[list[int], list[int], list[int]]:
    """The codes of tag36h11, and the column and the row of each bit, the most significant first."""
    detector = pyapriltags.Detector("tag36h11")
    family = detector.tag_families["tag36h11"].contents
    bits = family.nbits
    return family.codes[: family.ncodes], family.bit_x[:bits], family.bit_y[:bits]
