"""The names, types and units of a dataset file; described for people in docs/file-format.md."""

from dataclasses import dataclass

FORMAT = "contactgraph-dataset"
VERSION = 1
RUNS = "trajectories"
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
        """What an array must be, in words, for error messages."""
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
}
NAMES = ("node_name", "node_type")
