"""Robot logs: `open_log` reads ROS 1 bags, ROS 2 folders and bare .mcap files as streams of events."""

from localization.logs.info import LogInfo, TopicInfo, inspect_log
from localization.logs.reader import Log, open_log
from localization.logs.topic_roles import Sources, TopicOverrides, TopicSource

__all__ = ["Log", "LogInfo", "Sources", "TopicInfo", "TopicOverrides", "TopicSource", "inspect_log", "open_log"]
