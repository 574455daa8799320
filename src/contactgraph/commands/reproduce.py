"""``contactgraph reproduce``: the paper's studies, each from data to page by one command."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class Reproduce:
    """Record, train with several seeds, test on unseen scenes, and write tables and a page.

    Goes on where it was stopped: what is there already is not done again.
    """

    study: Positional[str] = "pickup"
    """The study: pickup."""
    quick: bool = False
    """One training seed and few test scenes."""
    out: Path = Path("results/pickup")
    """The folder to write."""

    def run(self) -> None:
        """Run the study."""
        from contactgraph.commands.names import looked_up

        looked_up("study", self.study, {"pickup": self._pickup})()

    def _pickup(self) -> None:
        from contactgraph.commands.collect import Collect
        from contactgraph.commands.conditions import Conditions
        from contactgraph.commands.study import measured, write_study
        from contactgraph.commands.train import Train

        seeds = (0,) if self.quick else (0, 1, 2)
        runs, episodes = (5, 10) if self.quick else (20, 100)
        conditions = Conditions("pickup", (0, 3, 10), runs, episodes, seed=1000)
        results, names = [], []
        for seed in seeds:
            folder = self.out / f"seed-{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            data, run = folder / "train.h5", folder / "run"
            if not data.exists():
                Collect("pickup", data, episodes=40, seed=seed).run()
            Train(data, run, seed=seed, resume=_has_checkpoint(run)).run()
            results.append(measured(str(run), conditions, folder, keep=True))
            names.append(str(run))
        option = " --quick" if self.quick else ""
        command = f"contactgraph reproduce pickup{option}"
        write_study(self.out / "index.html", results, names, "pickup", [command])


def _has_checkpoint(run: Path) -> bool:
    return any(run.glob("checkpoint-*.safetensors"))
