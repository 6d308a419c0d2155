"""Maps that outlive a process: keyframes with their scans in one file, and grids of them for others' planners. See README.md."""

from localization.maps.keyframe_map import KeyframeMap
from localization.maps.map_file import SavedMap, load_map, save_map

__all__ = ["KeyframeMap", "SavedMap", "load_map", "save_map"]
