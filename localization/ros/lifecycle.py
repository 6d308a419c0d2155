"""`skidloc_node`: the estimator as a managed ROS 2 node (lifecycle, parameters), through rclpy.

There is one thread: while the estimator runs, its transport spins the node, and with it the services of lifecycle and parameters.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from localization.errors import SettingError
from localization.ros.jit_warm_up import WarmUp
from localization.ros.node import Node, StopSignal
from localization.ros.node_config import Names
from localization.ros.settings import LiveRun, ManagedNodeSettings, make_settings, nearest, parameters
from localization.ros.transports.rclpy import RclpyTransport, import_rclpy
from localization.ros.transports.transport import SimTimeTransport, Transport
from motion_models.errors import SkidlocError

_IDLE_S = 0.2
_BAD_INPUT = 2
_FOREIGN = ("use_sim_time", "start_type_description_service")  # rclpy's own
_FOREIGN_PREFIX = "qos_overrides."


class ManagedNode:
    """Unconfigured at first; `run` until a signal or a shutdown."""

    def __init__(self, arguments: Sequence[str]) -> None:
        """``arguments`` as of ROS 2 (`--ros-args ...`). Raises `TransportError` without rclpy, `SettingError` for unknown parameters."""
        self._rclpy, lifecycle, signals = import_rclpy("", "lifecycle", "signals")
        self._messages: Any = importlib.import_module("rcl_interfaces.msg")  # rclpy itself needs it
        self._rclpy.init(args=["skidloc_node", *arguments], signal_handler_options=signals.SignalHandlerOptions.NO)
        self._node: Any = lifecycle.LifecycleNode("skidloc")
        self._log: Any = self._node.get_logger()
        self._settings: ManagedNodeSettings | None = None
        self._live_run: LiveRun | None = None
        self._estimator: Node | None = None
        self._is_active = self._is_shut_down = self._has_failed = False
        self._declare_parameters()
        self._node.add_on_set_parameters_callback(self._on_set_parameters)
        self._node.add_managed_entity(_make_entity(lifecycle, self))
        self._transport = RclpyTransport.on_node(self._node)

    def run(self) -> int:
        """The exit code."""
        with StopSignal() as stop:
            try:
                if self._node.get_parameter("autostart").value and not self._start():
                    return _BAD_INPUT
                while not (stop.is_set() or self._is_shut_down):
                    self._spin(stop)
                return _BAD_INPUT if self._has_failed and self._node.get_parameter("autostart").value else 0
            finally:
                self._transport.close()
                self._node.destroy_node()
                self._rclpy.try_shutdown()

    def _spin(self, stop: StopSignal) -> None:
        if self._is_active:
            self._estimate(stop)
        else:
            self._transport.take(_IDLE_S)

    def configure(self) -> None:
        """Read the parameters and begin to compile. Raises `SkidlocError`."""
        settings = self._read_settings()
        if not settings.robot:
            raise SettingError("parameter 'robot' is empty; it must be the name of a shipped robot or the path of a robot TOML file.")
        self._live_run = settings.live_run()
        WarmUp(self._live_run)  # compiles while the node waits to be activated
        self._settings = settings

    def activate(self) -> None:
        """Let the run begin as soon as it is back from this callback."""
        self._is_active = True

    def deactivate(self) -> None:
        """The run ends, and writes its files, as soon as it is back from this callback."""
        self._is_active = False

    def shut_down(self) -> None:
        """End the run, and the process after it."""
        self._is_active, self._is_shut_down = False, True

    def report_error(self, error: Exception) -> None:
        """Write ``error`` to the node's log."""
        self._log.error(str(error))

    def _start(self) -> bool:
        """Configure and activate; false where that failed."""
        self._node.trigger_configure()
        if self._settings is not None:
            self._node.trigger_activate()
        return self._is_active

    def _estimate(self, stop: StopSignal) -> None:
        """Until deactivated, or stopped. What fails is logged, and the node is inactive then."""
        assert self._settings is not None
        assert self._live_run is not None
        settings, files = self._settings, self._live_run.files
        transport: Transport = SimTimeTransport(self._transport) if settings.node.use_sim_time else self._transport

        def is_over() -> bool:
            return stop.is_set() or not self._is_active

        answers = ThreadPoolExecutor(1, "set-up")
        try:
            with files.claimed():
                self._estimator = Node.start(transport, self._live_run, self._log.warning, is_over, executor=answers)
                self._log.info(f"running {settings.model} in {settings.estimator} on {', '.join(self._estimator.topics)}")
                self._estimator.spin(is_over)
                count = self._estimator.finish()
                if count is not None:
                    self._log.info(f"{files.out}: {count} estimates")
        except KeyboardInterrupt:
            self._log.info("ended while it waited for topics")
        except SkidlocError as error:
            self._fail(error)
        finally:
            answers.shutdown(wait=False, cancel_futures=True)
            self._estimator = None
            self._transport.release()

    def _fail(self, error: SkidlocError) -> None:
        self.report_error(error)
        self._has_failed = True
        if self._is_active:
            self._node.trigger_deactivate()
            self._is_shut_down = bool(self._node.get_parameter("autostart").value)  # no manager would activate it again

    def _declare_parameters(self) -> None:
        """Raises `SettingError` for a parameter that does not exist: rclpy would ignore it."""
        known = {parameter.name for parameter in parameters()}
        for name in self._node._parameter_overrides:
            if name not in known and name not in _FOREIGN and not name.startswith(_FOREIGN_PREFIX):
                raise SettingError(f"there is no parameter '{name}'.{nearest(name, sorted(known))}")
        for parameter in parameters():
            descriptor = self._messages.ParameterDescriptor(
                description=parameter.description,
                additional_constraints=parameter.constraint,
                dynamic_typing=True,  # types are checked by `make_settings`, which takes 5 for 5.0
            )
            self._node.declare_parameter(parameter.name, parameter.default, descriptor)

    def _read_settings(self, changed: Sequence[Any] = ()) -> ManagedNodeSettings:
        """Settings of the parameters, with those ``changed``. Raises `SettingError`."""
        values = {parameter.name: self._node.get_parameter(parameter.name).value for parameter in parameters()}
        values |= {parameter.name: parameter.value for parameter in changed if parameter.name in values}
        use_sim_time = bool(self._node.get_parameter("use_sim_time").value)
        return make_settings(values, Names(self._node.get_name(), self._node.get_namespace()), use_sim_time=use_sim_time)

    def _on_set_parameters(self, changed: Sequence[Any]) -> Any:
        result = self._messages.SetParametersResult
        dynamic = {parameter.name for parameter in parameters() if parameter.is_dynamic}
        try:
            settings = self._read_settings(changed)
        except SkidlocError as error:
            return result(successful=False, reason=str(error))
        fixed = [parameter.name for parameter in changed if parameter.name not in dynamic and parameter.name not in _FOREIGN]
        if self._is_active and fixed:
            return result(
                successful=False, reason=f"{', '.join(fixed)}: deactivate and clean up first, it is read when the node is configured."
            )
        if self._estimator is not None:
            self._estimator.publish_tf(settings.node.tf)
        return result(successful=True)


def _make_entity(lifecycle: Any, managed: ManagedNode) -> Any:
    """The managed entity that rclpy calls at transitions."""
    done = lifecycle.TransitionCallbackReturn

    class Entity(lifecycle.ManagedEntity):  # type: ignore[misc]
        def on_configure(self, state: Any) -> Any:
            try:
                managed.configure()
            except SkidlocError as error:
                managed.report_error(error)
                return done.FAILURE
            return done.SUCCESS

        def on_activate(self, state: Any) -> Any:
            managed.activate()
            return done.SUCCESS

        def on_deactivate(self, state: Any) -> Any:
            managed.deactivate()
            return done.SUCCESS

        def on_cleanup(self, state: Any) -> Any:
            return done.SUCCESS

        def on_shutdown(self, state: Any) -> Any:
            managed.shut_down()
            return done.SUCCESS

    return Entity()


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns the exit code: 0, 2 for bad input."""
    try:
        return ManagedNode(sys.argv[1:] if arguments is None else arguments).run()
    except SkidlocError as error:
        print(f"skidloc_node: {error}", file=sys.stderr)
        return _BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
