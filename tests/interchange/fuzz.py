"""Reads damaged files of every format: ``python fuzz.py COUNT SEED [FORMAT …]``.

Each is read as a recording, or refused by an `InvalidInputError` of one line, and soon. The script
prints how many of each kind there were, and the slowest one; anything else ends it with an error.
"""

import json
import random
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import recordings

from contactgraph.data import InvalidInputError
from contactgraph.interchange import SceneMap, read_map, to_trajectories
from contactgraph.interchange.csv_table import read_csv
from contactgraph.interchange.draft import draft_map
from contactgraph.interchange.lerobot import read_lerobot
from contactgraph.interchange.minari import read_minari
from contactgraph.interchange.recording import Recording
from contactgraph.interchange.robomimic import read_robomimic
from contactgraph.interchange.rosbag import read_rosbag
from contactgraph.interchange.scene_map import parse_map

LONGEST_S = 10.0
WRONG = (None, True, -1, 0, 1e308, 2**70, "nan", "x" * 50, [], {}, [[1]], [None], "../../etc")
WORDS = (
    b"nan",
    b"inf",
    b"-",
    b"1e999",
    b'"',
    b"\x00",
    b"\xff",
    b",,,,",
    b"text",
    b"\n",
    b"1" * 400,
)


@dataclass(frozen=True)
class Damage:
    """Damages copies of a good recording."""

    read: Callable[[Path], Recording]
    good: Path
    map: SceneMap

    def once(self, folder: Path, rng: random.Random) -> str:
        """Damages one file and reads; the reason of a refusal, or none."""
        copy = folder / self.good.name
        if self.good.is_dir():
            shutil.copytree(self.good, copy, dirs_exist_ok=True)
        else:
            shutil.copy(self.good, copy)
        files = [copy] if copy.is_file() else sorted(p for p in copy.rglob("*") if p.is_file())
        damage(rng.choice(files), rng)
        try:
            recording = self.read(copy)
            draft_map(recording)
            to_trajectories(recording, self.map)
        except InvalidInputError as error:
            assert "\n" not in str(error), error
            assert len(str(error)) < 3000, error
            return str(error)
        return ""


def damage(path: Path, rng: random.Random) -> None:
    """Changes a file: its JSON, its bytes, its length."""
    if path.suffix == ".json" and rng.random() < 0.7:
        content = json.loads(path.read_text())
        change(content, rng)
        path.write_text(json.dumps(content))
        return
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 1, 2, 5, 30))):
        at = rng.randrange(len(content) + 1)
        kind = rng.randrange(6)
        if kind == 0:
            del content[at:]
        elif kind == 1:
            del content[at : at + rng.randrange(1, 40)]
        elif kind == 2:
            content[at : at + rng.randrange(8)] = rng.choice(WORDS)
        elif kind == 3:
            content[at : at + 4] = rng.randrange(2**32).to_bytes(4, "little")
        elif kind == 4:
            content[at : at + 8] = rng.choice((b"\xff" * 8, b"\x00" * 8))
        elif content:
            content[at % len(content)] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def change(content: object, rng: random.Random) -> None:
    """Removes a value somewhere in JSON, or replaces it by one of another kind."""
    while isinstance(content, dict | list) and content:
        key = rng.choice(list(content) if isinstance(content, dict) else range(len(content)))
        if not isinstance(content[key], dict | list) or rng.random() < 0.4:
            if rng.random() < 0.3:
                del content[key]
            else:
                content[key] = rng.choice(WRONG)
            return
        content = content[key]


def formats(folder: Path) -> dict[str, Damage]:
    """A good recording of each format."""
    take = recordings.motive_file(folder / "take.csv")
    demonstrations = recordings.robomimic_file(folder / "demo.hdf5")
    trial = recordings.nexus_file(folder / "trial.csv")
    bag = recordings.mcap_file(folder / "bag.mcap")
    plain = folder / "plain.csv"
    plain.write_text("time,hand.x,hand.y\n" + "".join(f"{t},{t / 2},1\n" for t in range(30)))
    drafts = {path: parse_map("draft", draft_map(read_csv(path))) for path in (take, plain, trial)}
    return {
        "minari": Damage(
            read_minari, recordings.minari_folder(folder / "minari"), read_map("fetch-push")
        ),
        "lerobot": Damage(
            read_lerobot, recordings.lerobot_folder(folder / "lerobot"), read_map("pusht")
        ),
        "csv": Damage(read_csv, plain, drafts[plain]),
        "motive": Damage(read_csv, take, drafts[take]),
        "robomimic": Damage(
            read_robomimic,
            demonstrations,
            parse_map("draft", draft_map(read_robomimic(demonstrations))),
        ),
        "nexus": Damage(read_csv, trial, parse_map("draft", draft_map(read_csv(trial)))),
        "rosbag": Damage(read_rosbag, bag, parse_map("draft", draft_map(read_rosbag(bag)))),
    }


def main(count: int, seed: int, *names: str) -> None:
    """Damages and reads ``count`` files of each of these formats, else of all."""
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "damaged").mkdir()
        for name, each in formats(folder).items():
            if names and name not in names:
                continue
            refused, slowest = 0, (0.0, "")
            for index in range(count):
                begin = time.perf_counter()
                try:
                    reason = each.once(folder / "damaged", random.Random(f"{seed} {index}"))
                except BaseException:
                    print(f"{name}: file {index} of seed {seed}", file=sys.stderr, flush=True)
                    raise
                refused += bool(reason)
                slowest = max(slowest, (time.perf_counter() - begin, f"file {index}: {reason}"))
            print(f"{name}: {count} files, {refused} refused, slowest {slowest[0]:.2f} s")
            assert slowest[0] < LONGEST_S, slowest


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
