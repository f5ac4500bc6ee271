"""Managed node: its transitions, as in the design of ROS 2 lifecycle nodes.

=============  ==========================================================================
State          What the node has in this state
=============  ==========================================================================
unconfigured   only parameters and the services of the life cycle
inactive       also topics, services and journal; poses are not accepted
active         the same; poses are accepted
finalized      nothing; the process waits for a signal to end
=============  ==========================================================================

``cleanup`` and ``shutdown`` save the result, and end the session.
"""

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.node import Node

from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.state import GRACE_S

_DONE = TransitionCallbackReturn.SUCCESS


class ManagedNode(LifecycleNodeMixin, Node):
    """A node that another program may configure, activate, deactivate and clean up.

    A subclass makes its topics, services and timers in :meth:`configure`, and ends its work in
    :meth:`stop`.

    Attributes
    ----------
    is_configured : bool
        Whether :meth:`configure` has succeeded, and no cleanup has followed.
    """

    _log: NodeLog

    def __init__(self, name: str, **options: Any) -> None:
        Node.__init__(self, name, **options)
        self.is_configured = False
        # Closing this stack destroys what configure() has made.
        self._made = ExitStack()

    def manage(self) -> None:
        """Serve the transitions. After this call, only transitions configure the node."""
        LifecycleNodeMixin.__init__(self)
        change_state = self._service_change_state.callback

        def change_state_if_possible(request: Any, response: Any) -> Any:
            # rclpy raises an error for a transition that is impossible in the present state, such
            # as a second activation. The error would end the node.
            try:
                return change_state(request, response)
            except RCLError:
                _, state = self._state_machine.current_state
                wanted = request.transition.label or request.transition.id
                self._log.warning(
                    f"transition {wanted} is refused: the node is {state}"
                )
                response.success = False
                return response

        self._service_change_state.callback = change_state_if_possible

    def configure(self) -> None:
        """Make topics, services and timers. Poses are not accepted yet.

        Raises
        ------
        HandEyeCalibError
            If an option cannot be applied.
        """
        raise NotImplementedError

    def accept_poses(self, accept: bool) -> None:
        """Accept or ignore the poses from now on."""
        raise NotImplementedError

    def stop(self, timeout_s: float) -> bool:
        """Save the result and end the session. Return False if the save failed."""
        raise NotImplementedError

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make topics, services and timers. If this fails, the log contains the reason."""
        self._made = ExitStack()
        self._destroy_later()
        try:
            self.configure()
        except HandEyeCalibError as error:
            self._log.error(f"the node is not configured: {error}")
            self._made.close()
            return TransitionCallbackReturn.FAILURE
        self.is_configured = True
        return _DONE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Accept poses."""
        self.accept_poses(True)
        return _DONE

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Ignore poses. Results remain published."""
        self.accept_poses(False)
        return _DONE

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Save the result, end the session, and destroy topics, services and timers."""
        if self.is_configured:
            # If the result cannot be saved, the log contains a warning.
            self.stop(GRACE_S)
        self.is_configured = False
        self._made.close()
        return _DONE

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Do what a cleanup does, from any state."""
        return self.on_cleanup(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Do what a cleanup does after an exception. The node can be configured again."""
        return self.on_cleanup(state)

    def _destroy_later(self) -> None:
        """Register for destruction all publishers, subscriptions and so on made from now on."""
        kinds: dict[str, Callable[[Any], object]] = {
            "publishers": self.destroy_publisher,
            "subscriptions": self.destroy_subscription,
            "services": self.destroy_service,
            "timers": self.destroy_timer,
            "guards": self.destroy_guard_condition,
        }
        before = {
            kind: {id(item) for item in getattr(self, kind)} for kind in kinds
        }

        def destroy() -> None:
            for kind, destroy_item in kinds.items():
                for item in list(getattr(self, kind)):
                    if id(item) not in before[kind]:
                        destroy_item(item)

        self._made.callback(destroy)
