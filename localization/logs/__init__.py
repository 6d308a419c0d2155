"""Robot logs: `open_log` reads ROS 1 bags, ROS 2 folders and bare .mcap files as streams of events."""

from typing import TYPE_CHECKING

from motion_models import exports

if TYPE_CHECKING:
    from localization.logs.info import LogInfo, TopicInfo, inspect_log
    from localization.logs.reader import Log, open_log
    from localization.logs.topic_roles import Sources, TopicOverrides, TopicSource

__all__ = ["Log", "LogInfo", "Sources", "TopicInfo", "TopicOverrides", "TopicSource", "inspect_log", "open_log"]

_MODULES = {
    "localization.logs.info": "LogInfo TopicInfo inspect_log",
    "localization.logs.reader": "Log open_log",
    "localization.logs.topic_roles": "Sources TopicOverrides TopicSource",
}
__getattr__ = exports(__name__, {name: module for module, names in _MODULES.items() for name in names.split()})
