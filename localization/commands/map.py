"""`skidloc map`: what a saved map holds, and its export for planners and viewers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from localization.commands.common import new_folder, print_line, write_json
from localization.errors import MapError
from localization.maps import SavedMap, load_map, save_map
from localization.output import check_outputs


@dataclass(frozen=True)
class MapInfo:
    """Show what a map holds and where it comes from."""

    file: tyro.conf.Positional[Path]
    """Map written by `skidloc replay --save-map`."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write the same to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        check_outputs(self.json)
        found = summary(load_map(self.file))
        for line in _lines(found):
            print_line(console, line)
        if self.json is not None:
            write_json(self.json, found)


@dataclass(frozen=True)
class MapExport:
    """Write a map as map_server's .pgm and .yaml, as .png, and its points as .ply. Of a map in space, the grid has what stands within a
    range of heights above the ground."""

    file: tyro.conf.Positional[Path]
    """Map written by `skidloc replay --save-map`."""
    out: Path
    """New folder for map.pgm, map.yaml (map_server, nav2), map.png and map.ply."""
    resolution: float = 0.05
    """Side of a cell [m]."""
    heights: tuple[float, float] | None = None
    """Lowest and highest above the ground that is a wall in the grid of a map in space [m]; default: 0.3 1.8."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        from localization.maps.export import exports
        from localization.maps.grid import draw_grid
        from localization.maps.height_slice import HEIGHTS_M, HeightSlice

        check_outputs(self.out)
        mapped = load_map(self.file).map
        if mapped.is_in_space:
            grid = HeightSlice(mapped, self.heights or HEIGHTS_M).grid(self.resolution)
        elif self.heights is None:
            grid = draw_grid(mapped, self.resolution)
        else:
            raise MapError(f"--heights are those of a map in space, and '{self.file}' holds planar scans. Leave them out.")
        with new_folder(self.out) as folder:
            for name, content in exports(grid, mapped).items():
                (folder / name).write_bytes(content)
        height, width = grid.cells.shape
        print_line(console, f"{width} x {height} cells of {self.resolution:g} m: {self.out / 'map.yaml'}")


@dataclass(frozen=True)
class MapView:
    """Write a page that shows a map in a browser: its grid, keyframes with their sigma, and loop closures."""

    file: tyro.conf.Positional[Path]
    """Map written by `skidloc replay --save-map`."""
    out: Path
    """New .html file, which needs no network."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        from localization.report.map_page import map_page
        from localization.report.page import write_new

        check_outputs(self.out)
        saved = load_map(self.file)
        write_new(self.out, map_page(self.file.name, saved.map, _lines(summary(saved)), saved.provenance).encode())
        print_line(console, f"page: {self.out}")


@dataclass(frozen=True)
class MapMerge:
    """Join the map of a second drive to that of a first one, in whose frame it then is, and show how well both agree."""

    first: tyro.conf.Positional[Path]
    """Map written by `skidloc replay --save-map`."""
    second: tyro.conf.Positional[Path]
    """Another map of the same building."""
    out: Path
    """New file for the merged map."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        from localization.estimators import merge_maps
        from localization.lidar import LidarConfig

        check_outputs(self.out)
        first, second = load_map(self.first), load_map(self.second)
        found = merge_maps(first.map, second.map, LidarConfig().range_noise_m)
        save_map(self.out, SavedMap(found.map, {"merged_from": [dict(first.provenance), dict(second.provenance)]}))
        print_line(console, f"{found.closed} of {len(second.map.poses)} keyframes of '{self.second}' were found in '{self.first}'")
        for name, values in (("their scans are off the merged map by", found.errors), ("the second map was bent by", found.bent)):
            print_line(console, f"{name} {np.median(values):.3f} m in the median, {np.quantile(values, 0.95):.3f} m at 95 %")


@dataclass(frozen=True)
class Map:
    """Print, view or export a saved map, or merge two."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[MapInfo, tyro.conf.subcommand("info")]
        | Annotated[MapExport, tyro.conf.subcommand("export")]
        | Annotated[MapView, tyro.conf.subcommand("view")]
        | Annotated[MapMerge, tyro.conf.subcommand("merge")]
    ]

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        self.action.run(console)


def summary(saved: SavedMap) -> dict[str, Any]:
    """Size, extent [m] and uncertainty of a map, and its provenance."""
    mapped = saved.map
    points, n = mapped.points_in_map(), 3 if mapped.is_in_space else 2
    size = np.ptp(points, axis=0) if len(points) else np.zeros(n)
    sigma = np.sqrt(np.trace(mapped.covariances[:, :n, :n], axis1=1, axis2=2)).max()
    return {
        "keyframes": len(mapped.poses),
        "points": len(mapped.points),
        "loop_closures": int(mapped.edge_is_loop.sum()),
        "size_m": size.round(2).tolist(),
        "sigma_m": round(float(sigma), 4),
        **saved.provenance,
    }


def _lines(found: Mapping[str, Any]) -> list[str]:
    size = " x ".join(f"{side:.1f} m" for side in found["size_m"])
    kind = " in space" if len(found["size_m"]) > 2 else ""
    lines = [
        f"{found['keyframes']} keyframes{kind} with {found['points']} points and {found['loop_closures']} loop closures",
        f"{size}; positions of keyframes have a sigma of at most {found['sigma_m']:.3f} m against the first.",
    ]
    named = [f"{key} {found[key]}" for key in ("log", "robot", "model", "corrections") if found.get(key)]
    mounts = found.get("mounts")
    sensors = [f"{name} at {_numbers(mount)}" for name, mount in mounts.items()] if isinstance(mounts, dict) else []
    return [*lines, *(", ".join(part) for part in (named, sensors) if part)]


def _numbers(mount: Any) -> str:
    """x, y, z [m] and yaw [deg] of a mount, as far as it has them."""
    values = mount if isinstance(mount, dict) else {}
    x, y, z, yaw = (values[key] if isinstance(values.get(key), (int, float)) else math.nan for key in ("x", "y", "z", "yaw"))
    return f"({x:g}, {y:g}, {z:g}) m, {math.degrees(yaw):g} deg"
