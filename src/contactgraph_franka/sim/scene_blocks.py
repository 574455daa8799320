"""The blocks of a rehearsal, as its scene and its camera know them."""

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.sim.tagged_block import MASS, TaggedBlock, tagged_block

LARGEST_COUNT = 2
"""As many as there are tags for."""
CONTACT = {"solref": ".003 1", "solimp": ".95 .99 .001", "condim": "4"}
WOOD_FRICTION = ".5 .005 .0001"
"""As in the arm's task: of a block on the table."""
_PLACES = ((0.5, -0.15, 0.05), (0.5, 0.15, 0.05))
"""m: where blocks stand at first."""
_TAGS = 9
"""Of each block."""


def scene_blocks(count: int, mass: float = MASS) -> tuple[TaggedBlock, ...]:
    """Node 1 and on of a scene with ``count`` blocks of ``mass`` kg; node 0 is the hand.

    Raises `InvalidInputError` for a count that there are no tags for, or a mass that is none.
    """
    if not 0 <= count <= LARGEST_COUNT:
        raise InvalidInputError(f"blocks must be 0 to {LARGEST_COUNT}, found {count}")
    if not 0.01 <= mass <= 10.0:
        raise InvalidInputError(f"mass of a block must be 0.01 to 10 kg, found {mass}")
    made = tuple(
        tagged_block(f"block{index}", np.array(place), first_tag=_TAGS * index, mass=mass)
        for index, place in enumerate(_PLACES[:count])
    )
    for block in made:
        for shape in block.body.findall("geom[@name]"):
            shape.attrib.update(CONTACT, friction=WOOD_FRICTION)
    return made


def block_names(count: int) -> list[str]:
    """The names of nodes 1 and on."""
    return ["block", *(f"block-{index}" for index in range(1, count))][:count]
