"""Parameters of the node, made from the dataclasses of options."""

import re
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import (
    OptionField,
    Options,
    check_value,
    did_you_mean,
)

_OF_NODE = NodeConfig.by_name()
FIELDS = CalibratorConfig.by_name() | _OF_NODE

# Parameters that rclpy declares.
_SYSTEM_PARAMETERS = ("use_sim_time", "start_type_description_service")

# Names of topics, or of options for topics, that are no parameters: parent_topic, child2_odom ...
_OF_TOPIC = re.compile(
    r"(?:(parent|child\d*)_?)?(?:odom|odometry|pose|imu)?_?(?:topics?|odom|odometry)"
)


class Parameters:
    """Declare the parameters on a node, and store them as objects of options.

    The node must have been made with ``automatically_declare_parameters_from_overrides=True``.
    rclpy then lists the values from files and from the command line, including unknown names.

    Parameters
    ----------
    node : rclpy.node.Node
    on_change : callable
        Function that is called after a change of parameters with the earlier CalibratorConfig. At
        this time the attributes ``calibrator`` and ``node`` have the new options.
    check : callable
        Function that is called with a NodeConfig. It raises ConfigError for options that cannot be
        applied.

    Attributes
    ----------
    given : dict
        Values that the user has set, including values that equal their defaults.
    calibrator : CalibratorConfig
    node : NodeConfig
    unknown : list of str
        A line for each parameter that does not exist, except QoS overrides.

    Raises
    ------
    ConfigError
        If a value is of the wrong type or out of range.
    """

    def __init__(
        self,
        node: Node,
        on_change: Callable[[CalibratorConfig], None],
        check: Callable[[NodeConfig], None],
    ) -> None:
        declared: dict[str, Any] = node.get_parameters_by_prefix("")
        overrides = {
            name: parameter.value
            for name, parameter in declared.items()
            if name not in _SYSTEM_PARAMETERS
        }
        # The parameters are declared again below, with descriptors.
        for name in overrides:
            node.undeclare_parameter(name)
        self.unknown = [
            f"parameter {name} does not exist and is ignored{_advice(name, value)}"
            for name, value in overrides.items()
            if name not in FIELDS and not name.startswith("qos_overrides.")
        ]
        # YAML reads the word off without quotes as false.
        if overrides.get("journal") is False:
            overrides["journal"] = "off"
        self.given = _checked(overrides)
        self.calibrator, self.node = _configs(self.given)
        check(self.node)
        self._check_node = check
        self._on_change = on_change
        for name, field in FIELDS.items():
            value = self.given.get(name, field.default)
            node.declare_parameter(
                name, value, _descriptor(field), ignore_override=True
            )
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _proposed(self, parameters: list[Parameter]) -> Options:
        """Return the values of all parameters after a change."""
        changes = {parameter.name: parameter.value for parameter in parameters}
        return {**self.given, **_checked(changes)}

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Accept or refuse a change before it is applied."""
        try:
            _, node = _configs(self._proposed(parameters))
            self._check_node(node)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        """Store a change that was accepted."""
        if any(parameter.name in FIELDS for parameter in parameters):
            before = self.calibrator
            self.given = self._proposed(parameters)
            self.calibrator, self.node = _configs(self.given)
            self._on_change(before)


def _advice(name: str, value: object) -> str:
    """Return the end of the line about a parameter that does not exist; empty without advice."""
    match = _OF_TOPIC.fullmatch(name)
    if not match:
        return did_you_mean(name, FIELDS)
    topic = value if isinstance(value, str) and value else "TOPIC"
    return f"; a topic is set with -r {match[1] or 'parent'}_odom:={topic}"


def _checked(values: Options) -> Options:
    """Return the values of the parameters that this node has, in the right types.

    Raises
    ------
    ConfigError
        If a value is of the wrong type or out of range.
    """
    names = [name for name in FIELDS if name in values]
    return {name: check_value(FIELDS[name], values[name]) for name in names}


def _configs(values: Options) -> tuple[CalibratorConfig, NodeConfig]:
    """Return the option objects of parameters."""
    of_node = {
        name: value for name, value in values.items() if name in _OF_NODE
    }
    of_calibrator = {
        name: value for name, value in values.items() if name not in _OF_NODE
    }
    return CalibratorConfig.from_options(
        of_calibrator
    ), NodeConfig.from_options(of_node)


def _descriptor(field: OptionField) -> ParameterDescriptor:
    """Return description, type and range of a parameter for ``ros2 param describe``."""
    meta = field.metadata
    words = meta["choices"]
    # A value that is a number or a word, such as "estimate", has no fixed type.
    is_dynamic = bool(meta["words"])
    if is_dynamic and not words:
        words = (f"{' or '.join(meta['words'])}, or a number",)
    description = meta["doc"]
    if meta["unit"]:
        description += f" Unit: {meta['unit']}."
    if words:
        description += f" Values: {', '.join(words)}."
    descriptor = ParameterDescriptor(
        description=description,
        read_only=meta["read_only"],
        dynamic_typing=is_dynamic,
    )
    if meta["within"] is not None:
        low, high = meta["within"]
        if isinstance(field.default, int):
            descriptor.integer_range = [
                IntegerRange(from_value=int(low), to_value=int(high))
            ]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
    return descriptor
