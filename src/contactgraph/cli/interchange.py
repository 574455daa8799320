"""``contactgraph import`` and ``contactgraph export``: datasets from and to other formats."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from contactgraph.data import Dataset, InvalidInputError, read_trajectories, write_trajectories
from contactgraph.data.lookup import choice

FORMATS = ("minari", "lerobot", "csv", "rosbag", "robomimic")


@dataclass(frozen=True)
class Import:
    """Make a dataset of a recording in another format, by a map of its columns."""

    format: Positional[Annotated[str, arg(metavar="FORMAT")]]
    """minari, lerobot (version 3), csv (also of Motive or Vicon), rosbag (MCAP) or robomimic."""
    source: Positional[Annotated[Path, arg(metavar="SOURCE")]]
    """The file or folder to read."""
    map: Annotated[
        str | None, arg(metavar="MAP", help_behavior_hint="(required without --inspect)")
    ] = None
    """A map in TOML, or the name of one that ships: fetch-push, fetch-slide, fetch-pick-and-place,
    pusht or pusht-state."""
    out: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(required without --inspect)")
    ] = None
    """The dataset file to write (HDF5)."""
    inspect: bool = False
    """Print the columns, and a draft of a map below them."""

    def run(self) -> None:
        """Read, convert and write."""
        from contactgraph.cli.output import check_writable
        from contactgraph.interchange import (
            read_map,
            shipped_maps,
            to_trajectories,
            velocity_warning,
        )
        from contactgraph.interchange.csv_table import read_csv
        from contactgraph.interchange.draft import draft_map
        from contactgraph.interchange.lerobot import read_lerobot
        from contactgraph.interchange.minari import read_minari
        from contactgraph.interchange.motion import body_motions, motion_warnings
        from contactgraph.interchange.robomimic import read_robomimic
        from contactgraph.interchange.rosbag import read_rosbag

        read_all = (read_minari, read_lerobot, read_csv, read_rosbag, read_robomimic)
        readers = dict(zip(FORMATS, read_all, strict=True))
        read = choice("FORMAT", self.format, readers)
        if not self.source.exists():
            raise InvalidInputError(f"{self.source}: does not exist")
        if self.inspect:
            print(draft_map(read(self.source)), end="")
            return
        if self.map is None or self.out is None:
            raise InvalidInputError(
                "import needs --map and --out, or --inspect; maps that ship are "
                f"{', '.join(shipped_maps())}"
            )
        check_writable(self.out)
        place = self.out.resolve()
        source = self.source.resolve()
        if place in (Path(self.map).resolve(), source) or (
            place.exists() and source in place.parents
        ):
            raise InvalidInputError(f"{self.out}: must not be the recording or the map")
        scene_map = read_map(self.map)
        recording = read(self.source)
        trajectories, notes = to_trajectories(recording, scene_map)
        dataset = Dataset(trajectories, {"source": self.format, "map": Path(self.map).name})
        warning = velocity_warning(dataset)
        if warning is not None:
            hint = "leave velocity out of the map to derive them from positions"
            print(f"warning: {warning}; {hint}", file=sys.stderr)
        motions = body_motions(dataset)
        hint = " missing = 0 in [[body]] leaves zeros out, and max_speed refuses more"
        for warning in motion_warnings(motions, hint):
            print(f"warning: {warning}", file=sys.stderr)
        write_trajectories(self.out, dataset.trajectories, dataset.metadata)
        steps = sum(each.steps for each in dataset)
        names = ", ".join(dataset.trajectories[0].scene.node_name)
        print(f"{self.out}: {len(dataset)} trajectories of {names}")
        print(f"  {steps} steps of {dataset.dt:g} s, of {len(recording.episodes)} episodes")
        for each in (*motions, *notes):
            print(f"  {each}")


@dataclass(frozen=True)
class Export:
    """Write a dataset in another format."""

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """The dataset file."""
    to: Annotated[str, arg(metavar="FORMAT")]
    """minari, lerobot (version 3) or csv."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder to write, with a map.toml by which import reads it back."""

    def run(self) -> None:
        """Read and write."""
        from contactgraph.interchange.csv_table import write_csv
        from contactgraph.interchange.export_layout import export_layout
        from contactgraph.interchange.lerobot import write_lerobot
        from contactgraph.interchange.minari import write_minari

        writers = {"minari": write_minari, "lerobot": write_lerobot, "csv": write_csv}
        write = choice("--to", self.to, writers)
        layout = export_layout(read_trajectories(self.data))
        write(layout, self.out)
        print(
            f"{self.out}: {len(layout.dataset)} trajectories, {len(layout.names)} numbers a state"
        )
        if layout.left_out:
            print(f"  not in this format, left out: {', '.join(layout.left_out)}")
