"""The layouts for RViz and Foxglove name what the node has."""

import json
import re
from pathlib import Path

import pytest
import yaml

from hand_eye_calib.watch.board import AXES

CONFIG = Path(__file__).resolve().parents[2] / "config"
NODE_PAGE = (CONFIG.parent / "docs" / "node.md").read_text(encoding="utf-8")

# Properties of the classes of RViz 2 (Jazzy), and fields of the panels of Foxglove, by the names
# that their sources have. Both programs ignore a name that they do not know.
RVIZ = {
    "rviz_default_plugins/Grid": "Cell Size, Plane Cell Count, Normal Cell Count, Line Style, "
    "Line Width, Color, Alpha, Plane, Offset, Reference Frame",
    "rviz_default_plugins/Axes": "Length, Radius, Reference Frame",
    "rviz_default_plugins/PoseWithCovariance": "Shape, Axes Length, Axes Radius, Alpha, Color, "
    "Head Length, Head Radius, Shaft Length, Shaft Radius, Covariance, Topic",
    "rviz_default_plugins/TF": "Frame Timeout, Marker Scale, Show Arrows, Show Axes, Show Names, "
    "Update Interval",
    "rviz_default_plugins/MoveCamera": "",
    "rviz_default_plugins/FocusCamera": "",
    "rviz_default_plugins/Measure": "Line color",
    "rviz_default_plugins/Orbit": "Distance, Focal Point, Focal Shape Size, Pitch, Yaw, "
    "Near Clip Distance, Target Frame",
    "rviz_common/Displays": "Property Tree Widget, Tree Height",
    "rviz_common/Views": "",
}
RVIZ_PARTS = {
    "Covariance": "Position, Orientation",
    "Position": "Alpha, Color, Scale",
    "Orientation": "Alpha, Color, Color Style, Frame, Offset, Scale",
    "Topic": "Depth, Durability Policy, Filter size, History Policy, Reliability Policy",
}
FOXGLOVE = {
    "3D": "cameraState followMode followTf scene transforms topics layers publish imageMode",
    "DiagnosticSummary": "topicToRender minLevel pinnedIds hardwareIdFilter sortByLevel",
    "DiagnosticStatusPanel": "topicToRender selectedHardwareId selectedName",
    "Plot": "foxglovePanelTitle paths showXAxisLabels showYAxisLabels showLegend legendDisplay "
    "showPlotValuesInLegend isSynced xAxisVal sidebarDimension",
    "CallService": "serviceName requestPayload layout buttonText",
}


@pytest.fixture
def rviz():
    return yaml.safe_load((CONFIG / "calibrator.rviz").read_text())


@pytest.fixture
def displays(rviz):
    return {each["Name"]: each for each in rviz["Visualization Manager"]["Displays"]}


@pytest.fixture
def layout():
    return json.loads((CONFIG / "foxglove_layout.json").read_text())


def test_rviz_shows_the_latched_extrinsic_with_its_covariance(displays):
    extrinsic = displays["Extrinsic"]
    assert extrinsic["Topic"]["Value"] == "/calibrator/extrinsic_with_covariance"
    assert extrinsic["Topic"]["Durability Policy"] == "Transient Local"
    assert extrinsic["Covariance"]["Position"]["Value"] is True
    assert "`~/extrinsic_with_covariance`" in NODE_PAGE


def test_rviz_knows_every_class_and_property(rviz, displays):
    manager = rviz["Visualization Manager"]
    parts = [*rviz["Panels"], *displays.values(), *manager["Tools"], manager["Views"]["Current"]]
    for part in parts:
        known = {*RVIZ[part["Class"]].split(", "), "Class", "Name", "Enabled", "Value"}
        assert set(part) <= known, part["Class"]
    assert manager["Transformation"]["Current"]["Class"] in RVIZ
    extrinsic = displays["Extrinsic"]
    for name, part in (extrinsic | extrinsic["Covariance"]).items():
        if isinstance(part, dict):
            assert set(part) <= {*RVIZ_PARTS[name].split(", "), "Value"}, name


def test_foxglove_knows_every_panel_and_field(layout):
    for name, config in layout["configById"].items():
        assert set(config) <= set(FOXGLOVE[name.partition("!")[0]].split()), name
    (pose,) = layout["configById"]["3D!extrinsic"]["topics"].values()
    assert set(pose) <= {"visible", "type", "axisScale", "showCovariance"}
    assert pose["type"] in ("axis", "arrow")


def test_foxglove_shows_what_the_node_publishes_and_serves(layout):
    panels = layout["configById"]
    services = [each["serviceName"] for each in panels.values() if "serviceName" in each]
    assert sorted(services) == [f"/calibrator/{name}" for name in ("reset", "save", "solve")]
    for name in services:
        assert f"`~/{name.rpartition('/')[2]}`" in NODE_PAGE
    assert list(panels["3D!extrinsic"]["topics"]) == ["/calibrator/extrinsic_with_covariance"]
    values = [path["value"] for each in panels.values() for path in each.get("paths", ())]
    keys = set(re.findall(r'key=="([a-z.]+)"', " ".join(values)))
    assert keys == {*(f"sigma.{axis}" for axis in AXES), "target.x", "target.roll"}


def test_every_panel_of_the_foxglove_layout_is_placed_once(layout):
    def placed(part):
        if isinstance(part, str):
            return [part]
        return [*placed(part["first"]), *placed(part["second"])]

    assert sorted(placed(layout["layout"])) == sorted(layout["configById"])
