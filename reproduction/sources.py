"""Sources of the cases of an experiment: the published trajectories, or simulated drives."""

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hand_eye_calib.simulation.drive import simulate_drive
from hand_eye_calib.simulation.options import MIXTURE, PUBLISHED_DRIVE, NoiseConfig
from reproduction import published
from reproduction.published import Case

_KITTI_LOADERS = {
    "kitti_short": published.load_kitti_short,
    "kitti_long": published.load_kitti_long,
}


@dataclass(frozen=True)
class PublishedSource:
    """The published trajectories and results.

    Parameters
    ----------
    folder : str
        See :mod:`~reproduction.published`.
    """

    folder: str
    data = "published"
    datasets = (*published.SIMULATED, *published.KITTI)
    runs = published.N_RUNS

    def cases(self, dataset: str, level: float | None) -> list[Case]:
        """List of Case of a data set at a level; None for those without levels."""
        if dataset in _KITTI_LOADERS:
            return [_KITTI_LOADERS[dataset](self.folder)]
        return published.load_simulated(self.folder, [dataset], None if level is None else [level])

    def configuration(self) -> dict[str, Any]:
        """What the cases depend on, for telling whether stored results still hold: names, sizes and
        times of the files.
        """
        folder = published.check_folder(self.folder)
        listing = hashlib.sha256()
        for name in ("kitti_tests", "simulation_tests", published.results_folder(folder).name):
            for path in sorted((folder / name).rglob("*.[ct]*")):
                status = path.stat()
                listing.update(
                    f"{path.relative_to(folder)} {status.st_size} {status.st_mtime_ns}\n".encode()
                )
        return {"data": self.data, "files": listing.hexdigest()}


@dataclass(frozen=True)
class SimulatedSource:
    """Drives like the published ones, made by our simulator.

    Parameters
    ----------
    seed : int
    runs : int
        Drives; every one appears at every level, as in the paper.
    """

    seed: int = 0
    runs: int = published.N_RUNS
    data = "simulated"
    datasets = published.SIMULATED

    def cases(self, dataset: str, level: float | None) -> list[Case]:
        """List of Case of a data set at a level; without published results."""
        noise = _noise(dataset, level)
        return [self._case(dataset, level, noise, number) for number in range(self.runs)]

    def _case(self, dataset: str, level: float | None, noise: NoiseConfig, number: int) -> Case:
        drive = simulate_drive((self.seed, number), PUBLISHED_DRIVE, noise)
        return Case(
            dataset,
            level,
            f"run_{number + 1:02}",
            drive.parent,
            drive.child,
            drive.T_parent_child,
            {},
        )

    def configuration(self) -> dict[str, Any]:
        """What the cases depend on."""
        return {
            "data": self.data,
            **asdict(self),
            "drive": PUBLISHED_DRIVE.to_options(),
            "mixture": MIXTURE.to_options(),
        }


Source = PublishedSource | SimulatedSource


def find_folder(folder: str | Path) -> str:
    """The folder of the published data: itself, or the folder valimaki2023 in it."""
    inside = Path(folder) / "valimaki2023"
    return str(published.check_folder(inside if inside.is_dir() else folder).resolve())


def _noise(dataset: str, level: float | None) -> NoiseConfig:
    if dataset == "mixture":
        return MIXTURE
    if level is None:
        raise ValueError(f"{dataset} needs a level")
    name, factor = {
        "noise": ("gaussian", 1.0),
        "outliers": ("outliers", 0.01),
        "drift": ("drift", 1.0),
    }[dataset]
    return NoiseConfig(**{name: factor * level})
