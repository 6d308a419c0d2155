"""Runs, references and pages for tests of reports."""

import dataclasses
import math
import re
from html.parser import HTMLParser

import numpy as np

from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import score
from localization.log_replay import Run
from localization.messages import message
from localization.report.replay_page import ReportHead
from localization.trajectory import Trajectory
from motion_models import se2

SECOND = 10**9
HEAD = ReportHead(
    "corridor.mcap",
    "vaultbot",
    "2026-01-02 03:04:05 UTC",
    200.0,
    [message("scans.empty", scans="3 scans")],
    {"skidloc": "0.1.0"},
    "c0ffee",
)


def drive(n=400, turns=2.0):
    """Laps on a circle of 5 m radius, one pose each half second."""
    angle = np.linspace(0.0, 2.0 * math.pi * turns, n)
    poses = np.column_stack([5.0 * np.sin(angle), 5.0 - 5.0 * np.cos(angle), angle])
    return np.arange(n, dtype=np.int64) * (SECOND // 2), poses


def run(
    model="diff_drive",
    estimator="ekf",
    noise=0.0,
    seed=0,
    nis=None,
    covariance=True,
    n=400,
    points=(),
    parameters=(),
    counts=(),
    warnings=(),
):
    stamps, poses = drive(n)
    rng = np.random.default_rng(seed)
    poses = se2.compose(poses, se2.exp(rng.normal(size=(n, 3)) * [noise, noise, 0.1 * noise]))
    spread = np.diag([0.04, 0.01, 0.001]) * np.linspace(0.0, 1.0, n)[:, None, None] + 1e-6 * np.eye(3)
    return Run(
        model=model,
        estimator=estimator,
        trajectory=Trajectory(stamps, poses, spread if covariance else None),
        twists=np.zeros((n, 3)),
        twist_covariances=np.zeros((n, 3, 3)),
        nis=np.full(n, np.nan) if nis is None else np.asarray(nis, dtype=float),
        parameters=dict(parameters),
        counts=dict(counts),
        map_points=np.array(points, dtype=float).reshape(-1, 2),
        seconds=1.0,
        warnings=warnings,
    )


def track(yaws=True):
    stamps, poses = drive()
    return ReferenceTrack(stamps, poses[:, :2], poses[:, 2] if yaws else None, source="/ground_truth/odom")


def relations(span=8):
    stamps, poses = drive()
    start = np.arange(0, 400 - span)
    return Relations(stamps[start], stamps[start + span], se2.between(poses[start], poses[start + span]), source="hand.relations")


def chi_square_nis(n=400, scale=1.0, seed=5):
    return scale * np.random.default_rng(seed).chisquare(3, n)


def three_runs():
    return [
        run("diff_drive", "odometry", 0.5, 1),
        run("skid_steer", "lidar", 0.8, 2, points=[(0, 0), (1, 1)]),
        run("skid_steer", "ekf", 0.05, 3, nis=chi_square_nis(), points=np.random.default_rng(9).uniform(-8, 12, (500, 2))),
    ]


def with_error(value, estimator="ekf", model="diff_drive"):
    """A result whose ATE is set to ``value``."""
    result = score([run(model, estimator, 0.1)], track())[0]
    return dataclasses.replace(result, accuracy=dataclasses.replace(result.accuracy, ate_rmse_m=value))


def without_scripts(made: str) -> str:
    """The page as it is without what a browser runs."""
    return re.sub(r"<script.*?</script>", "", made, flags=re.DOTALL)


class PageText(HTMLParser):
    """Cells of every table, the text, and the tags of a page; fails on tags that do not close."""

    VOID = frozenset({"meta", "br", "input", "wbr", "path", "image", "use", "rect", "stop"})

    def __init__(self, source):
        super().__init__()
        self.tables, self.open, self.tags, self.words = [], [], [], []
        self.feed(source)
        assert not self.open, f"never closed: {self.open}"

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" in self.open:
            return
        self.words.append(data)
        if "td" in self.open or "th" in self.open:
            self.tables[-1][-1][-1] += data
