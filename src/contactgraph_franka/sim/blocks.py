"""Blocks with tags on their faces, for MuJoCo and for the detector."""

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.pickup import BLOCK
from contactgraph_franka.perception.calibration import Tag, TaggedObject
from contactgraph_franka.perception.camera import pose, transform
from contactgraph_franka.perception.edges import CELLS
from contactgraph_franka.perception.tags import black_cells

MASS = 0.83
"""kg, of the paper's block."""
LARGEST_COUNT = 2
"""Blocks that there are tags for."""
CONTACT = {"solref": ".003 1", "solimp": ".95 .99 .001", "condim": "4"}
WOOD_FRICTION = ".5 .005 .0001"
"""Contact and friction of a block on the table, as in the arm's task."""
_POSITIONS = ((0.5, -0.15, 0.05), (0.5, 0.15, 0.05))  # Initial positions of the blocks, m
_TAGS_A_BLOCK = 9
_LIFT = 1e-4  # m, of the print above the paper, against flicker


@dataclass(frozen=True, eq=False)
class TaggedBlock:
    """A block as MJCF elements, and its tags for the detector."""

    body: ElementTree.Element
    """For the scene's ``worldbody``, with a free joint."""
    assets: tuple[ElementTree.Element, ...]
    """For its ``asset``; they refer to no files."""
    tagged: TaggedObject

    def append_to(self, scene: ElementTree.Element) -> None:
        """Adds the block to an MJCF tree whose root is ``scene``."""
        for name, parts in (("asset", self.assets), ("worldbody", (self.body,))):
            section = scene.find(name)
            if section is None:
                section = ElementTree.SubElement(scene, name)
            section.extend(parts)


def scene_blocks(count: int, mass: float = MASS) -> tuple[TaggedBlock, ...]:
    """The blocks of a scene, nodes 1 and on, of ``mass`` kg each; node 0 is the hand.

    Raises `InvalidInputError` for a count without tags, or an impossible mass.
    """
    if not 0 <= count <= LARGEST_COUNT:
        raise InvalidInputError(f"blocks must be 0 to {LARGEST_COUNT}, found {count}")
    if not 0.01 <= mass <= 10.0:
        raise InvalidInputError(f"mass of a block must be 0.01 to 10 kg, found {mass}")
    blocks = tuple(
        tagged_block(
            f"block{index}", np.array(position), first_tag=_TAGS_A_BLOCK * index, mass=mass
        )
        for index, position in enumerate(_POSITIONS[:count])
    )
    for block in blocks:
        for geom in block.body.findall("geom[@name]"):
            geom.attrib.update(CONTACT, friction=WOOD_FRICTION)
    return blocks


def tagged_objects(count: int) -> dict[str, TaggedObject]:
    """The tags of the blocks by the names of nodes 1 and on."""
    names = ["block", *(f"block-{index}" for index in range(1, count))][:count]
    return {name: each.tagged for name, each in zip(names, scene_blocks(count), strict=True)}


def tagged_block(
    name: str,
    position: np.ndarray,
    yaw: float = 0.0,
    first_tag: int = 0,
    sides: np.ndarray = BLOCK,
    mass: float = MASS,
) -> TaggedBlock:
    """A standing block at ``position`` [3] m and ``yaw`` rad with nine tags.

    Its frame is at its centre, z up. Each upright face has two tags, at its ends, so that the tilt
    is well observed and fingers around the middle cover none; the top has one. They are as large
    as the narrowest face of ``sides`` [3] m allows with a white border, 0.032 m for the default.
    Ids count from ``first_tag``. Raises `InvalidInputError` for unknown ids, or a block less
    than twice as high as wide.
    """
    width = float(min(sides[:2]))
    if sides[2] < 2.0 * width:
        raise InvalidInputError(f"sides of {name} must be twice as high as wide, found {sides}")
    size = width * CELLS / (CELLS + 2)
    tags = tuple(
        Tag(first_tag + number, size, tag_pose)
        for number, tag_pose in enumerate(_tag_poses(np.asarray(sides, float), width))
    )
    body = ElementTree.Element("body", name=name, pos=_text(position))
    body.set("quat", _text([np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)]))
    ElementTree.SubElement(body, "freejoint", name=f"{name}_free")
    paper = {"name": name, "type": "box", "size": _text(np.asarray(sides) / 2.0)}
    paper |= {"mass": str(mass), "material": f"{name}_paper", "friction": "1 .01 .001"}
    ElementTree.SubElement(body, "geom", paper)
    ink = {"type": "mesh", "mesh": f"{name}_print", "material": f"{name}_ink"}
    ElementTree.SubElement(body, "geom", ink, mass="0", contype="0", conaffinity="0")
    # Matt materials: reflections would hide a tag.
    materials = (
        ElementTree.Element(
            "material", name=f"{name}_{part}", rgba=colour, specular="0", reflectance="0"
        )
        for part, colour in (("paper", ".9 .9 .9 1"), ("ink", ".05 .05 .05 1"))
    )
    return TaggedBlock(body, (_print_mesh(name, tags), *materials), TaggedObject(tags))


def _tag_poses(sides: np.ndarray, width: float) -> list[np.ndarray]:
    """Poses [4, 4] of the tags in the block's frame."""
    up = np.array([0.0, 0.0, 1.0])
    end = (sides[2] - width) / 2.0
    poses = []
    for axis, sign in ((0, 1.0), (1, 1.0), (0, -1.0), (1, -1.0)):
        out = np.zeros(3)
        out[axis] = sign
        turn = np.stack([np.cross(up, out), up, out], axis=1)
        centre = out * (sides[axis] / 2.0 + _LIFT)
        poses += [pose(turn, centre + up * height) for height in (end, -end)]
    return [*poses, pose(np.eye(3), up * (sides[2] / 2.0 + _LIFT))]


def _print_mesh(name: str, tags: tuple[Tag, ...]) -> ElementTree.Element:
    """The black cells of all tags as one mesh, two triangles each.

    A texture would need a picture file, and is blurred when minified.
    """
    vertices: list[np.ndarray] = []
    faces: list[tuple[int, int, int]] = []
    line = np.arange(CELLS + 1) / CELLS - 0.5
    grid = np.stack([*np.meshgrid(line, -line), np.zeros((CELLS + 1, CELLS + 1))], axis=-1)
    for tag in tags:
        start = len(vertices) * grid[..., 0].size
        vertices.append(transform(tag.pose, grid.reshape(-1, 3) * tag.size))
        for row, column in np.argwhere(black_cells(tag.id)):
            corner = start + row * (CELLS + 1) + column
            below = corner + CELLS + 1
            faces += [(corner, below, below + 1), (corner, below + 1, corner + 1)]
    return ElementTree.Element(
        "mesh",
        name=f"{name}_print",
        inertia="shell",
        vertex=_text(np.concatenate(vertices).ravel()),
        face=" ".join(str(index) for face in faces for index in face),
    )


def _text(numbers: np.ndarray | list[float]) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)
