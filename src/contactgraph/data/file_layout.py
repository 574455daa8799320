"""The layout of dataset files, described in docs/file-format.md."""

from dataclasses import dataclass

FORMAT = "contactgraph-dataset"
VERSION = 2
"""The version that is written; all versions from 1 on are read."""
TRAJECTORIES = "trajectories"
METADATA = "metadata"


@dataclass(frozen=True)
class Field:
    """One array of a trajectory group."""

    shape: tuple[str, ...]
    """Letters of the axes; ``T+1`` counts states, ``T`` steps."""
    kinds: str
    """numpy's letters for the types that are read: b bool, i and u integer, f float."""
    unit: str | None = None
    since: int = 1
    """The first version of the format that has it; in files of earlier versions it is ignored."""

    @property
    def meaning(self) -> str:
        """The required shape and type in words, for error messages."""
        words = {"fiu": "floats or integers", "biu": "bools, or integers 0 and 1", "iu": "integers"}
        axes = ", ".join(self.shape) + ("," if len(self.shape) == 1 else "")
        return f"({axes}) of {words[self.kinds]}"


ARRAYS = {
    "position": Field(("T+1", "N", "D"), "fiu", "m"),
    "velocity": Field(("T+1", "N", "D"), "fiu", "m/s"),
    "control": Field(("T", "U"), "fiu", "N"),
    "skeleton": Field(("T+1", "P", "D"), "fiu", "m"),
    "actuated": Field(("N",), "biu"),
    "contact": Field(("T+1", "N", "N"), "biu"),
    "tracked": Field(("T+1", "N"), "biu"),
    "measured_at": Field(("T+1", "N"), "fiu", "s"),
    "anchor": Field(("N", "D"), "fiu", "m"),
    "goal": Field(("D",), "fiu", "m"),
    "gravity": Field(("D",), "fiu", "m/s^2"),
    "mass": Field(("N",), "fiu", "kg"),
    "radius": Field(("N",), "fiu", "m"),
    "size": Field(("N", "D"), "fiu", "m"),
    "candidate_edges": Field(("E", "2"), "iu"),
    "holding": Field(("T+1", "N", "N"), "biu", since=2),
    "orientation": Field(("T+1", "N", "1 or 4"), "fiu", since=2),
    "angular_velocity": Field(("T+1", "N", "1 or 3"), "fiu", "rad/s", since=2),
    "static": Field(("N",), "biu", since=2),
    "control_of": Field(("N", "U"), "biu", since=2),
    "planes": Field(("P", "D+1"), "fiu", since=2),
    "reach": Field(("N", "2", "D"), "fiu", "m", since=2),
    "polygons": Field(("W", "D"), "fiu", "m", since=2),
    "polygon_size": Field(("P",), "iu", since=2),
    "polygon_of": Field(("P",), "iu", since=2),
    "pins": Field(("P", "2"), "iu", since=2),
    "pin_points": Field(("P", "2", "D"), "fiu", "m", since=2),
}
OPTIONAL = set(ARRAYS) - {"position", "velocity", "control", "actuated"}
NAMES = ("node_name", "node_type")
CONTROL_KIND = "control_kind"
"""An optional array of names, from version 2 on."""
FIELD_OF = {"skeleton": "link_positions"}
"""Arrays whose field of `Trajectory` has another name."""
