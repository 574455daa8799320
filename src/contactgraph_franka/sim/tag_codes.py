"""Which cells of a tag36h11 are black: the family's published codes, for the tags of rehearsals."""

import numpy as np

from contactgraph.data import InvalidInputError

CELLS = 8
"""Black border included; a white one, a cell wide, must surround it."""
# Bits, the most significant first: three sides of a ring and its corner, turned by quarters.
_COLUMN = (1, 2, 3, 4, 5, 2, 3, 4, 3, 6, 6, 6, 6, 6, 5, 5, 5, 4)
_ROW = (1, 1, 1, 1, 1, 2, 2, 2, 3, 1, 2, 3, 4, 5, 2, 3, 4, 3)
_CODES = (
    0xD7E00984B,
    0xDDA664CA7,
    0xDC4A1C821,
    0xE17B470E9,
    0xEF91D01B1,
    0xF429CDD73,
    0x05DA29225,
    0x1106CBA43,
    0x223BED79D,
    0x21F51213C,
    0x33EB19CA6,
    0x3F76EB0F8,
    0x469A97414,
    0x45DCFE0B0,
    0x4A6465F72,
    0x51801DB96,
    0x5EB946B4E,
    0x68A7CC2EC,
    0x6F0BA2652,
    0x78765559D,
    0x87B83D129,
    0x86CC4A5C5,
    0x8B64DF90F,
    0x9C577B611,
)
TAGS = len(_CODES)
"""How many tags are known here: ids 0 to TAGS - 1."""


def black_cells(tag: int) -> np.ndarray:
    """[8, 8] bool, rows from the top: the cells of tag36h11 number ``tag`` that are black.

    Raises `InvalidInputError` for a tag whose code is not known here.
    """
    if not 0 <= tag < TAGS:
        raise InvalidInputError(f"tag must be 0 to {TAGS - 1}, found {tag}")
    black = np.ones((CELLS, CELLS), bool)
    half = list(zip(_COLUMN, _ROW, strict=True))
    both = half + [(CELLS - 1 - column, CELLS - 1 - row) for column, row in half]
    for bit, (column, row) in enumerate(both):
        black[row, column] = not _CODES[tag] >> (len(both) - 1 - bit) & 1
    return black
