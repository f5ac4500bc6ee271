"""The layouts for RViz and Foxglove name what the node has."""

import json
import re
from pathlib import Path

import yaml

from hand_eye_calib.watch.board import AXES

CONFIG = Path(__file__).resolve().parents[2] / "config"
NODE_PAGE = (CONFIG.parent / "docs" / "node.md").read_text(encoding="utf-8")


def test_rviz_shows_the_latched_extrinsic_with_its_covariance():
    rviz = yaml.safe_load((CONFIG / "calibrator.rviz").read_text())["Visualization Manager"]
    (extrinsic,) = (each for each in rviz["Displays"] if each["Name"] == "Extrinsic")
    assert extrinsic["Topic"]["Value"] == "/calibrator/extrinsic_with_covariance"
    assert extrinsic["Topic"]["Durability Policy"] == "Transient Local"
    assert extrinsic["Covariance"]["Position"]["Value"] is True
    assert "`~/extrinsic_with_covariance`" in NODE_PAGE


def test_foxglove_shows_what_the_node_publishes_and_serves_each_panel_once():
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text())
    panels = layout["configById"]
    services = [each["serviceName"] for each in panels.values() if "serviceName" in each]
    assert sorted(services) == [f"/calibrator/{name}" for name in ("reset", "save", "solve")]
    for name in services:
        assert f"`~/{name.rpartition('/')[2]}`" in NODE_PAGE
    assert list(panels["3D!extrinsic"]["topics"]) == ["/calibrator/extrinsic_with_covariance"]
    values = [path["value"] for each in panels.values() for path in each.get("paths", ())]
    keys = set(re.findall(r'key=="([a-z.]+)"', " ".join(values)))
    assert keys == {*(f"sigma.{axis}" for axis in AXES), "target.x", "target.roll"}

    def placed(part):
        if isinstance(part, str):
            return [part]
        return [*placed(part["first"]), *placed(part["second"])]

    assert sorted(placed(layout["layout"])) == sorted(panels)
