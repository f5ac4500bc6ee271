"""Sources of the cases of an experiment: the published trajectories, or simulated drives."""

from dataclasses import dataclass

from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import (
    MIXTURE,
    PUBLISHED_DRIVE,
    NoiseConfig,
)
from reproduction import published
from reproduction.published import Case


@dataclass(frozen=True)
class PublishedSource:
    """The published trajectories and results, in the folder of :mod:`~reproduction.published`."""

    folder: str
    is_published = True
    datasets = (*published.SIMULATED, *published.KITTI)
    runs = published.N_RUNS

    def cases(self, dataset: str, level: float | None) -> list[Case]:
        """Return the cases of a data set at a level.

        ``level`` is None for data sets without levels.
        """
        if dataset == "kitti_short":
            return [published.load_kitti_short(self.folder)]
        if dataset == "kitti_long":
            return [published.load_kitti_long(self.folder)]
        return published.load_simulated(
            self.folder, [dataset], None if level is None else [level]
        )


@dataclass(frozen=True)
class SimulatedSource:
    """Simulated drives like the published ones; all drives appear at all levels, as in the paper.

    Attributes
    ----------
    seed : int
        Seed of all drives.
    runs : int
        Number of drives.
    """

    seed: int = 0
    runs: int = published.N_RUNS
    is_published = False
    datasets = published.SIMULATED

    def cases(self, dataset: str, level: float | None) -> list[Case]:
        """Return the cases of a data set at a level. The cases have no published results.

        ``level`` is None for data sets without levels.
        """
        noise = _noise(dataset, level)
        cases = []
        for number in range(self.runs):
            drive = simulate_drive((self.seed, number), PUBLISHED_DRIVE, noise)
            streams = drive.parent, drive.child, drive.T_parent_child
            cases.append(
                Case(dataset, level, f"run_{number + 1:02}", *streams, {})
            )
        return cases


Source = PublishedSource | SimulatedSource


def _noise(dataset: str, level: float | None) -> NoiseConfig:
    """Return the noise of a data set at a level; the paper's mixture if there are no levels."""
    if level is None:
        return MIXTURE
    if dataset == "noise":
        return NoiseConfig(gaussian=level)
    return (
        NoiseConfig(outliers=0.01 * level)
        if dataset == "outliers"
        else NoiseConfig(drift=level)
    )
