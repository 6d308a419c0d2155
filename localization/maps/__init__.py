"""Maps that outlive a process: keyframes with their scans in one file, and grids of them for others' planners. See README.md."""

from localization.maps.keyframe_map import KeyframeMap
from localization.maps.map_file import SavedMap, load_map, save_map
from localization.maps.space_map import SpaceMap

__all__ = ["KeyframeMap", "SavedMap", "SpaceMap", "load_map", "save_map"]
