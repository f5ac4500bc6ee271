"""Values of the parameters of the node that are not their defaults."""

LAX = {"threshold": 1e-9}

STREAMS = ("parent", "child")

# Parameters that change the answer while the node runs: another value, and what has to be set
# beforehand for it to matter.
CHANGES = {
    "method": ("park", {}),
    "reference": ("B7", {}),
    "backend": ("ipopt", {}),
    "threshold": (1e-5, {}),
    "min_inlier_fraction": (0.9, LAX),
    "min_pairs": (1000, {}),
    "max_pairs": (50, {}),
    "keyframe.min_translation": (0.5, {}),
    "keyframe.min_rotation": (0.3, {}),
    "keyframe.min_interval": (0.45, {}),
    "max_gap": (0.05, {}),
    "time_offset": (0.03, {}),
    "scale": (2, {}),
    "parent_scale": (1.5, {}),
    **{f"{stream}_invert": ("poses", {}) for stream in STREAMS},
    **{f"{stream}_quaternion": ("wxyz", {}) for stream in STREAMS},
    **{f"{stream}_kind": ("exact", {}) for stream in STREAMS},
    "target.translation": (1e-5, {}),
    "target.rotation": (1e-5, {}),
    "target.axes": ("yaw=1e-5", {}),
    # Streams without wheel data are refused.
    "nominal_radius": (0.1, {}),
    "nominal_separation": (0.5, {}),
    **{f"prior.{axis}": ("1+/-0.001", {}) for axis in "xyz"},
    **{
        f"prior.{axis}": ("10deg+/-0.01deg", {})
        for axis in ("roll", "pitch", "yaw")
    },
}

# Of every parameter a value that is not its default, as typed on the command line and as a ROS
# parameter.
GIVEN = {name: (str(value), value) for name, (value, _) in CHANGES.items()} | {
    "threshold": ("1", 1.0),
    "min_inlier_fraction": ("1", 1.0),
    "time_offset": ("estimate", "estimate"),
    "target.translation": ("0.1", 0.1),
    "target.rotation": ("0.01", 0.01),
    "parent_frame": ("123", "123"),
    "child_frame": ("true", "true"),
    "solve_period": ("4", 4.0),
    "parent_type": ("nav_msgs/msg/Odometry", "nav_msgs/msg/Odometry"),
    "child_type": (
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseStamped",
    ),
    "output_directory": ("{folder}/out", "{folder}/out"),
    "journal": ("off", "off"),
    "publish_tf": ("true", True),
    **{f"{stream}_measures": ("poses", "poses") for stream in STREAMS},
    **{
        f"{stream}_tf": (f"odom:{stream}", f"odom:{stream}")
        for stream in STREAMS
    },
    "other_children": ("2", 2),
    "report": ("false", False),
    "installed": ("1 0 0 0 0 0", "1 0 0 0 0 0"),
    "base_frame": ("base_link", "base_link"),
    "monitor": ("true", True),
    "enabled": ("false", False),
    "lifecycle": ("true", True),
}

# monitor watches one child sensor.
TOGETHER = [set(GIVEN) - {"monitor"}, {"monitor", "installed"}]
