"""Names of topics as ROS 2 resolves them: namespace, private names, remapping rules."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass

from localization.errors import SettingError
from localization.logs.topic_roles import TopicOverrides
from localization.settings import Settings
from motion_models.robot import Robot

_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_NAMESPACE = re.compile(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+")
_TOPIC = re.compile(r"(~?/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_GLOBAL = ("/tf", "/tf_static", "/diagnostics")


@dataclass(frozen=True)
class Names(Settings):
    """The node's name, and how topics are named by it. Raises `SettingError` for names that ROS 2 does not allow."""

    name: str = "skidloc"
    """Node name; estimates are published on `~/odometry`, that is /NAMESPACE/NAME/odometry."""
    namespace: str = "/"
    """Namespace of the node. The robot file's topics are in it, those of --topic where they begin without `/`."""
    remap: tuple[str, ...] = ()
    """Rules FROM:=TO as of ROS 2, for topics of both directions: `scan:=front/scan`, `~/odometry:=odom`, `/tf:=tf`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NODE.fullmatch(self.name):
            raise SettingError(f"the node's name is '{self.name}'; it may hold letters, digits and '_', and no digit first.")
        if not _NAMESPACE.fullmatch(self.namespace):
            raise SettingError(f"the namespace is '{self.namespace}'; it must begin with '/', as in '/robot1', and not end with it.")
        for rule in self.remap:
            ends = rule.split(":=")
            if len(ends) != 2 or not all(_TOPIC.fullmatch(end) for end in ends):
                raise SettingError(f"the remapping rule is '{rule}'; it must be FROM:=TO with two names of topics, as in scan:=front/scan.")

    def resolve(self, topic: str) -> str:
        """The absolute name of ``topic`` after remapping; the first rule that fits counts."""
        full = self._expand(topic)
        return next((self._expand(after) for before, after in self._rules() if self._expand(before) == full), full)

    def in_namespace(self, topic: str) -> str:
        """``topic`` of a robot file, where namespaces are not known: absolute there, inside the namespace here."""
        return self.resolve(topic if topic in _GLOBAL else topic.lstrip("/")) if topic else topic

    def apply_to_robot(self, robot: Robot) -> Robot:
        """``robot`` with its topics as they are resolved here."""
        topics = {field.name: self.in_namespace(getattr(robot.topics, field.name)) for field in dataclasses.fields(robot.topics)}
        return dataclasses.replace(robot, topics=dataclasses.replace(robot.topics, **topics))

    def apply_to_overrides(self, topics: TopicOverrides) -> TopicOverrides:
        """``topics`` as they are resolved here; parts that are left out or not named stay so."""
        values = {field.name: getattr(topics, field.name) for field in dataclasses.fields(topics)}
        return dataclasses.replace(topics, **{name: self.resolve(topic) for name, topic in values.items() if topic})

    def _rules(self) -> list[tuple[str, str]]:
        return [(before, after) for before, after in (rule.split(":=") for rule in self.remap)]

    def _expand(self, topic: str) -> str:
        if topic.startswith("/"):
            return topic
        prefix = self.namespace.rstrip("/")
        return f"{prefix}/{self.name}{topic[1:]}" if topic.startswith("~") else f"{prefix}/{topic}"
