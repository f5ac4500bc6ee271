"""The growth curves: time against the number of pairs."""

from suite.baseline import FLOOR

_CURVES = {
    "adaptive": "adaptive estimator",
    "reference auto": "choice of the reference",
    "dnlo ipopt": "DNLO, CasADi + Ipopt",
    "dnlo fast": "DNLO, fast",
    "jackknife and covariance": "jackknife and covariance",
    FLOOR: "floor: one pass over the pairs",
}


def draw(rows, path):
    """Save the figure."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 4.6), layout="constrained")
    for name, label in _CURVES.items():
        points = sorted((row.size, row.seconds) for row in rows if row.name == name)
        if points:
            axes.loglog(*zip(*points, strict=True), marker="o", markersize=4, label=label)
    axes.set_xlabel("motion pairs")
    axes.set_ylabel("processor time, s")
    axes.grid(alpha=0.3, which="major")
    axes.legend(frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
