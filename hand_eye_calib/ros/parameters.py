"""The node's parameters, made from the option dataclasses."""

import dataclasses
import difflib
from collections.abc import Callable, Collection
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from hand_eye_calib.config import (
    CalibratorConfig,
    NodeConfig,
    OptionField,
    check_value,
    option_name,
)
from hand_eye_calib.errors import ConfigError

_Values = dict[str, Any]

_OF_CALIBRATOR: dict[str, OptionField] = {
    option_name(field): field for field in dataclasses.fields(CalibratorConfig)
}
_OF_NODE: dict[str, OptionField] = {
    option_name(field): field for field in dataclasses.fields(NodeConfig)
}
FIELDS = _OF_CALIBRATOR | _OF_NODE

# Declared by rclpy itself.
_SYSTEM_PARAMETERS = ("use_sim_time", "start_type_description_service")


class Parameters:
    """Declares the parameters on a node and keeps them as option objects.

    The node must have been made with ``automatically_declare_parameters_from_overrides=True``: so
    rclpy shows what a file or the command line sets, unknown names included.

    Parameters
    ----------
    node : rclpy.node.Node
    qos_names : collection of str
        Names of the QoS override parameters that the node's subscriptions will declare.
    check : callable
        ``check(NodeConfig)`` raises ConfigError for options that cannot be put in force.
    on_change : callable
        Called without arguments after parameters have changed; ``calibrator`` and ``node`` are the
        new options by then.

    Attributes
    ----------
    calibrator : CalibratorConfig
    node : NodeConfig
    unknown : list of str
        One line for every given name that does not exist.

    Raises
    ------
    ConfigError
        If a given value is of the wrong type or out of range.
    """

    def __init__(
        self,
        node: Node,
        qos_names: Collection[str],
        on_change: Callable[[], None],
        check: Callable[[NodeConfig], None] = lambda options: None,
    ) -> None:
        given = _take_overrides(node)
        self.unknown = [
            _unknown(name) for name in given if name not in FIELDS and name not in qos_names
        ]
        # Those that somebody set, at their defaults or not.
        self._values = {
            name: _start_value(field, given[name])
            for name, field in FIELDS.items()
            if name in given
        }
        self.calibrator, self.node = _configs(self._values)
        check(self.node)
        self._check_node = check
        for name, field in FIELDS.items():
            value = self._values.get(name, field.default)
            node.declare_parameter(name, value, _descriptor(field), ignore_override=True)
        self._on_change = on_change
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _proposed(self, parameters: list[Parameter]) -> _Values:
        ours = {
            parameter.name: parameter.value for parameter in parameters if parameter.name in FIELDS
        }
        return self._values | {
            name: check_value(FIELDS[name], value) for name, value in ours.items()
        }

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            _, node = _configs(self._proposed(parameters))
            self._check_node(node)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        if any(parameter.name in FIELDS for parameter in parameters):
            self._values = self._proposed(parameters)
            self.calibrator, self.node = _configs(self._values)
            self._on_change()


def _configs(values: _Values) -> tuple[CalibratorConfig, NodeConfig]:
    of_calibrator = {name: value for name, value in values.items() if name in _OF_CALIBRATOR}
    of_node = {name: value for name, value in values.items() if name in _OF_NODE}
    return CalibratorConfig.from_options(of_calibrator), NodeConfig.from_options(of_node)


def _take_overrides(node: Node) -> _Values:
    """Mapping of the names and values that file and command line give, undeclared again so that
    they can get descriptors.
    """
    parameters: dict[str, Any] = node.get_parameters_by_prefix("")
    given = {name: parameter.value for name, parameter in parameters.items()}
    for name in _SYSTEM_PARAMETERS:
        given.pop(name, None)
    for name in given:
        node.undeclare_parameter(name)
    return given


def _unknown(name: str) -> str:
    guesses = difflib.get_close_matches(name, FIELDS, n=1)
    return f"parameter {name} does not exist and is ignored" + (
        f"; did you mean {guesses[0]}?" if guesses else ""
    )


def _start_value(field: OptionField, value: Any) -> Any:
    # ROS parameters have fixed types: rclpy refuses an integer for a double, and so does `ros2
    # param set`.
    if isinstance(field.default, float) and type(value) is int and not _dynamic(field):
        raise ConfigError(
            f"{option_name(field)} must be a double; got the integer {value}: write {value}.0"
        )
    if value is False and "off" in (field.metadata["choices"] or ()):
        value = "off"  # which is what YAML makes of an off without quotes
    return check_value(field, value)


def _dynamic(field: OptionField) -> bool:
    """Whether a parameter takes a word as well as a number, and so has no single type."""
    return bool(field.metadata["words"])


def _descriptor(field: OptionField) -> ParameterDescriptor:
    meta = field.metadata
    words = meta["choices"] or (f"{' or '.join(meta['words'])}, or a number",) * _dynamic(field)
    unit = f" Unit: {meta['unit']}." if meta["unit"] else ""
    values = f" Values: {', '.join(words)}." if words else ""
    descriptor = ParameterDescriptor(
        description=f"{meta['doc']}{unit}{values}",
        additional_constraints=f"must be {meta['form']}" if meta["form"] else "",
        read_only=meta["read_only"],
        dynamic_typing=_dynamic(field),
    )
    bounds = meta["minimum"], meta["maximum"]
    if None not in bounds and not _dynamic(field):
        low, high = map(type(field.default), bounds)
        if isinstance(field.default, float):
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        else:
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return descriptor
