"""The layout of dataset files, described in docs/file-format.md."""

from dataclasses import dataclass

FORMAT = "contactgraph-dataset"
VERSION = 2
"""The version that is written and read."""
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
    "holding": Field(("T+1", "N", "N"), "biu"),
    "orientation": Field(("T+1", "N", "1 or 4"), "fiu"),
    "angular_velocity": Field(("T+1", "N", "1 or 3"), "fiu", "rad/s"),
    "static": Field(("N",), "biu"),
    "control_of": Field(("N", "U"), "biu"),
    "planes": Field(("P", "D+1"), "fiu"),
    "reach": Field(("N", "2", "D"), "fiu", "m"),
    "polygons": Field(("W", "D"), "fiu", "m"),
    "polygon_size": Field(("P",), "iu"),
    "polygon_of": Field(("P",), "iu"),
    "pins": Field(("P", "2"), "iu"),
    "pin_points": Field(("P", "2", "D"), "fiu", "m"),
}
OPTIONAL = set(ARRAYS) - {"position", "velocity", "control", "actuated"}
NAMES = ("node_name", "node_type")
CONTROL_KIND = "control_kind"
"""An optional array of names."""
FIELD_OF = {"skeleton": "link_positions"}
"""Arrays whose field of `Trajectory` has another name."""
