"""Starts the node ``calibrator`` on two topics with poses.

ros2 launch hand_eye_calib calibrator.launch.py parent_topic:=/lidar/odom child_topic:=/camera/odom
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# Arguments that become the parameter of the same name, when given; texts all but the last.
PARAMETERS = {
    "method": "Solver: dnlo, dnl, park, taylor, zhuang or ali; empty leaves it to the parameter file.",
    "reference": "Which poses form motion pairs: auto, A, B<n> or C<n>; empty leaves it to the parameter file.",
    "parent_frame": "Name of the parent sensor's frame; empty takes it from the messages.",
    "child_frame": "Name of the child sensor's frame; empty takes it from the messages.",
    "output_directory": "Where results and the session journal are written; empty leaves it to the parameter file.",
    "journal": "new begins a session, resume goes on with the one in output_directory, off keeps none; empty leaves it to the parameter file.",
    "publish_tf": "true broadcasts the result on /tf_static; leave it off where the robot's description has this edge.",
}


def calibrator(context):
    # An argument that was not given must not override the parameter file, hence not simply a
    # dictionary of substitutions.
    given = {
        name: text for name in PARAMETERS if (text := LaunchConfiguration(name).perform(context))
    }
    overrides = {
        name: ParameterValue(text, value_type=bool if name == "publish_tf" else str)
        for name, text in given.items()
    }
    overrides["use_sim_time"] = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    return [
        Node(
            package="hand_eye_calib",
            executable="calibrator",
            name="calibrator",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("config_file"), overrides],
            remappings=[
                ("parent_odom", LaunchConfiguration("parent_topic")),
                ("child_odom", LaunchConfiguration("child_topic")),
            ],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
        )
    ]


def generate_launch_description():
    default_config = PathJoinSubstitution(
        [FindPackageShare("hand_eye_calib"), "config", "calibrator.yaml"]
    )
    arguments = {
        "parent_topic": ("parent_odom", "Topic with the poses of the parent sensor."),
        "child_topic": ("child_odom", "Topic with the poses of the child sensor."),
        **{name: ("", description) for name, description in PARAMETERS.items()},
        "config_file": (default_config, "File with the node's parameters."),
        "namespace": ("", "Namespace of the node; relative topics are looked for in it."),
        "use_sim_time": (
            "false",
            "Whether the node's clock follows /clock, as with a bag played with --clock.",
        ),
        "log_level": ("info", "debug, info, warn, error or fatal."),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument(name, default_value=default, description=description)
            for name, (default, description) in arguments.items()
        ]
        + [OpaqueFunction(function=calibrator)]
    )
