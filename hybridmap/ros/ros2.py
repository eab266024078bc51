"""ROS 2, by rclpy: raw messages in, bytes out, and a lifecycle node."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from queue import SimpleQueue
from typing import Any, Protocol

from hybridmap.errors import HybridMapError, RosError
from hybridmap.ros.contents import Contents
from hybridmap.ros.fastdds import provide_buffers
from hybridmap.ros.middleware import OUTPUTS, Output, Service, ServiceKind
from hybridmap.ros.ros2_types import endpoint, filled, serialised
from hybridmap.streams.messages import Topic

_DEEP = 2000
"""Messages that wait in a subscription, where the publisher is reliable, before one is lost."""
_QUEUE = 100
_DRAIN_S = 30.0
_THREADS_END_S = 5.0

HOW_TO = "source the setup.bash of your ROS 2, or `python tools/ros2.py FOLDER` makes an environment with it without root"


def import_rclpy() -> Any:
    """The module rclpy.

    Raises:
        RosError: it cannot be imported; the message says how to get it.
    """
    try:
        import rclpy
        import rclpy.lifecycle
    except ImportError as error:
        raise RosError(f"rclpy cannot be imported ({error}): {HOW_TO}") from None
    return rclpy


class Transitions(Protocol):
    """What a lifecycle node does. A transition that raises a HybridMapError is not made."""

    def configure(self) -> None:
        """From unconfigured to inactive."""

    def activate(self) -> None:
        """From inactive to active."""

    def deactivate(self) -> None:
        """From active to inactive."""

    def cleanup(self) -> None:
        """From inactive to unconfigured."""

    def shutdown(self) -> None:
        """To the end, from anywhere."""


class Ros2:
    """A node of ROS 2; see `middleware.Middleware`.

    Messages are taken by one thread of rclpy and worked on by one thread for each topic, so that a picture holds up no
    odometry. The node is there, with its lifecycle, from the beginning; what it publishes and serves from `begin`.
    """

    is_ros1 = False

    def __init__(self, name: str, remappings: Sequence[str] = ()) -> None:
        """Make the node.

        Args:
            name: of the node; `__node:=...` replaces it.
            remappings: rules of `--ros-args -r`, such as `map:=/floor_2`.

        Raises:
            RosError: there is no rclpy, or it cannot begin; a rule is none.
        """
        self._rclpy = import_rclpy()
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.signals import SignalHandlerOptions

        wrong = [rule for rule in remappings if ":=" not in rule]
        if wrong:
            raise RosError(f"{wrong[0]!r} is no remapping of ROS: expected NAME:=NAME, such as map:=/floor_2")
        arguments = [word for rule in remappings for word in ("-r", rule)]
        self._profile = provide_buffers()
        from rclpy.impl.implementation_singleton import rclpy_implementation

        self._gone = rclpy_implementation.InvalidHandle
        self._context = self._rclpy.Context()
        self._stopped: list[Callable[[], None]] = []
        self._outputs: dict[Output, Any] = {}
        self._services: dict[str, Any] = {}
        self._workers: list[_Worker] = []
        try:
            options = SignalHandlerOptions.NO
            self._rclpy.init(
                args=["hybridmap", *(["--ros-args", *arguments] if arguments else [])],
                context=self._context,
                signal_handler_options=options,
            )
            self._transitions: Transitions | None = None
            self._node = _lifecycle_node(name, self._context, lambda: self._transitions)
            self._executor = self._rclpy.executors.SingleThreadedExecutor(context=self._context)
        except Exception as error:  # noqa: BLE001  rclpy has many
            self._remove_profile()
            raise RosError(f"ROS 2 cannot begin: {' '.join(str(error).split())}") from None
        self._executor.add_node(self._node)
        self._group = ReentrantCallbackGroup()  # a call that is not answered holds up no other
        self._wake = self._node.create_guard_condition(lambda: None, self._group)  # an answer wakes no executor by itself
        self._context.on_shutdown(self._tell_stopped)
        self.source = f"ROS 2, node {self._node.get_fully_qualified_name()}"
        self._spinner = threading.Thread(target=self._spin, name="hybridmap-rclpy", daemon=True)

    # ------------------------------------------------------------------ lifecycle

    def follow(self, transitions: Transitions, *, autostart: bool) -> None:
        """Let others move the node through its lifecycle, from now on.

        Args:
            transitions: what is done.
            autostart: configure and activate it at once.

        Raises:
            HybridMapError: it does not become active.
        """
        self._transitions = transitions
        if autostart:
            for name, trigger in (("configure", self._node.trigger_configure), ("activate", self._node.trigger_activate)):
                if trigger() != self._rclpy.lifecycle.TransitionCallbackReturn.SUCCESS:
                    raise self._node.error or RosError(f"{self.source}: the transition {name!r} has failed")
        self._spinner.start()

    def begin(self) -> None:
        """Make the topics that the node publishes."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        for output in OUTPUTS:
            if output in self._outputs:
                continue
            quality = QoSProfile(depth=_QUEUE)
            if output.latched:
                quality = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            create, topic = self._node.create_lifecycle_publisher, _name(output.topic)
            try:
                self._outputs[output] = endpoint(create, output.msgtype, topic, quality)
            except RosError as error:
                self.warn(f"{output.topic} is not published: {error}")

    def end(self) -> None:
        """Take in what has come, and let go of subscriptions and services."""
        workers, self._workers = self._workers, []
        for worker in workers:
            self._node.destroy_subscription(worker.subscription)
        until_s = time.monotonic() + _DRAIN_S
        for worker in workers:
            worker.end(max(0.0, until_s - time.monotonic()))
        for service in self._services.values():
            self._node.destroy_service(service)
        self._services.clear()

    def forget(self) -> None:
        """Let go of the topics that the node publishes."""
        for publisher in self._outputs.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._outputs.clear()

    # ------------------------------------------------------------------ middleware

    def topics(self) -> list[Topic]:
        """The topics that others publish, as far as this node has heard."""
        own = (self._node.get_name(), self._node.get_namespace())
        found = []
        for name, types in self._node.get_topic_names_and_types(no_demangle=False):
            publishers = self._node.get_publishers_info_by_topic(name)
            if any((one.node_name, one.node_namespace) != own for one in publishers):
                found += [Topic(name, msgtype, 1) for msgtype in types]
        return sorted(found, key=lambda topic: (topic.name, topic.msgtype))

    def subscribe(self, topic: str, msgtype: str, take: Callable[[bytes, str | None], None]) -> None:
        """Have `take` called with the bytes of each message, in a thread of this topic.

        The subscription is reliable and gets earlier messages where all publishers of the topic offer that; where there is
        none yet it asks for neither, so that it hears any.
        """
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        reliability, durability = ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE
        if self._node.count_publishers(topic):
            reliability, durability = ReliabilityPolicy.BEST_AVAILABLE, DurabilityPolicy.BEST_AVAILABLE
        quality = QoSProfile(depth=_DEEP, reliability=reliability, durability=durability)
        worker = _Worker(topic, lambda data: take(data, None))
        worker.subscription = endpoint(
            self._node.create_subscription, msgtype, topic, worker.put, quality, raw=True, callback_group=self._group
        )
        self._workers.append(worker)

    def publish(self, output: Output, contents: Contents) -> None:
        """Publish a message, unless the node is not active."""
        publisher = self._outputs.get(output)
        if publisher is None or not publisher.is_activated:
            return
        if output.latched or publisher.get_subscription_count():
            with suppress(self._gone):  # let go of in this moment
                publisher.publish(serialised(output.msgtype, contents))

    def offer(self, services: Sequence[Service]) -> None:
        """Offer services. Where one raises a HybridMapError, it is logged, and the answer is empty."""
        for service in services:
            package, _, kind = service.kind.value.partition("/")
            found = _service_class(package, kind)
            name, answer = _name(service.name), self._answering(service)
            self._services[service.name] = self._node.create_service(found, name, answer, callback_group=self._group)

    def _answering(self, service: Service) -> Callable[[Any, Any], Any]:
        """Answer in a thread of its own, as messages must be taken meanwhile."""

        async def answer(request: Any, response: Any) -> Any:
            done = self._rclpy.task.Future(executor=self._executor)

            def work() -> None:
                try:
                    value = bool(request.data) if service.kind is ServiceKind.SET_BOOL else False
                    filled(response, service.does(value))
                except HybridMapError as error:
                    self.warn(f"{service.name.lstrip('~')}: {error}")
                finally:
                    done.set_result(response)
                    self._wake.trigger()

            threading.Thread(target=work, name="hybridmap-service", daemon=True).start()
            return await done

        return answer

    def warn(self, text: str) -> None:
        """Tell the operator, on /rosout and the console."""
        self._node.get_logger().warning(text)

    def inform(self, text: str) -> None:
        """Tell the operator what is as it should be."""
        self._node.get_logger().info(text)

    def when_stopped(self, call: Callable[[], None]) -> None:
        """Have `call` called when rclpy shuts down."""
        self._stopped.append(call)

    def stop(self) -> None:
        """Take leave of the others."""
        self._executor.shutdown(_THREADS_END_S)
        if self._spinner.is_alive():
            self._spinner.join(_THREADS_END_S)
        self._node.destroy_node()
        self._context.try_shutdown()
        self._remove_profile()

    # ------------------------------------------------------------------ own

    def _spin(self) -> None:
        try:
            with suppress(self._rclpy.executors.ExternalShutdownException, self._rclpy.executors.ShutdownException):
                self._executor.spin()
        finally:
            self._tell_stopped()  # nothing more will come: the drive is over

    def _tell_stopped(self) -> None:
        for call in self._stopped:
            call()

    def _remove_profile(self) -> None:
        if self._profile is not None:
            self._profile.unlink(missing_ok=True)


class _Worker:
    """A thread that works on the messages of one topic, in the order in which they came."""

    def __init__(self, topic: str, take: Callable[[bytes], None]) -> None:
        self.subscription: Any = None
        self._take, self._waiting = take, SimpleQueue[bytes | None]()
        self.put: Callable[[bytes], None] = self._waiting.put
        self._thread = threading.Thread(target=self._work, name=f"hybridmap-{topic}", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while (data := self._waiting.get()) is not None:
            self._take(data)

    def end(self, timeout_s: float) -> None:
        """Wait until all is done."""
        self._waiting.put(None)
        self._thread.join(timeout_s)


def _service_class(package: str, kind: str) -> Any:
    try:
        return getattr(import_module(f"{package}.srv"), kind)
    except ImportError as error:
        raise RosError(
            f"ROS 2 has no service type {package}/srv/{kind} here ({error}): install the package {package}"
        ) from None


def _name(name: str) -> str:
    """As ROS 2 has it: what is private to a node begins with `~/`."""
    return f"~/{name[1:]}" if name.startswith("~") else name


def _lifecycle_node(name: str, context: Any, transitions: Callable[[], Transitions | None]) -> Any:
    """A lifecycle node that does what `transitions` gives."""
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

    def done(node: Any, step: str, rest: Callable[[Any], Any], state: Any) -> Any:
        """Do a step of ours, then that of the publishers."""
        found = transitions()
        try:
            if found is not None:
                getattr(found, step)()
        except HybridMapError as error:
            node.error = error
            node.get_logger().error(f"{step}: {error}")
            return TransitionCallbackReturn.FAILURE
        return rest(state)

    class Node(LifecycleNode):  # type: ignore[misc]  # rclpy is not known where types are checked
        error: HybridMapError | None = None

        def on_configure(self, state: Any) -> Any:
            return done(self, "configure", super().on_configure, state)

        def on_activate(self, state: Any) -> Any:
            return done(self, "activate", super().on_activate, state)

        def on_deactivate(self, state: Any) -> Any:
            return done(self, "deactivate", super().on_deactivate, state)

        def on_cleanup(self, state: Any) -> Any:
            return done(self, "cleanup", super().on_cleanup, state)

        def on_shutdown(self, state: Any) -> Any:
            return done(self, "shutdown", super().on_shutdown, state)

    return Node(name, context=context)
