"""Errors of a trajectory against a reference: ATE, RPE per distance, end error and drift, and the relations metric.

Each metric is defined where it is computed. Numbers without a reference are None, never 0. The lever arm between the tracked point of
the reference (a GPS antenna) and the robot's base is unknown and not removed; it is part of the error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

import numpy as np

from localization.bounded_settings import Positive, Settings
from localization.errors import EvaluationError
from localization.evaluation.references import ReferenceTrack, Relations, no_overlap_message
from localization.messages import Message
from localization.trajectory import IntArray, Trajectory, path_nodes
from motion_models import se2
from motion_models.se2 import FloatArray

_MIN_MATCHES = 3


@dataclass(frozen=True)
class EvaluateConfig(Settings):
    """Settings of the metrics."""

    max_gap_s: Positive = 1.0
    """Reference samples between two poses further apart than this [s] are not scored: there the estimate is only interpolation."""
    rpe_distances_m: tuple[float, ...] = ()
    """Lengths of the sub-paths of the relative pose error [m]; without any, 1, 2, 5, 10, 20, 50, ... up to what was driven."""
    path_resolution_m: float = 0.05
    """Steps of the path shorter than this [m] are jitter at standstill, and no distance."""
    short_span_s: float = 20.0
    """Relations that span less than this [s] are scored on their own, too."""


@dataclass(frozen=True)
class RpeAtLength:
    """Relative pose error over all sub-paths of one length (see `relative_pose_errors`)."""

    length_m: float
    n: int
    """Number of sub-paths."""
    translation_percent: float
    """Mean translation error per distance driven [%]."""
    rotation_deg_per_m: float
    """Mean rotation error per distance driven [deg/m]."""


@dataclass(frozen=True)
class RelationErrors:
    """Errors over a set of relations: means of the absolute value and of the square, as published for the Freiburg benchmark."""

    n: int
    translation_m: float
    translation_m2: float
    rotation_deg: float
    rotation_deg2: float


@dataclass(frozen=True)
class RelationsScore:
    """The metric of Kümmerle et al. 2009 and Burgard et al. 2009 (see `score_relations`)."""

    all: RelationErrors
    short: RelationErrors | None
    """Only the relations that span less than `EvaluateConfig.short_span_s`; None if there are none."""
    long: RelationErrors | None
    """The others; None if there are none."""


@dataclass(frozen=True, eq=False)
class ErrorSeries:
    """Errors over time after the alignment by the whole path, for plots."""

    stamps_ns: IntArray
    """(N,) the matched stamps of the reference."""
    estimate: FloatArray
    """(N, 3) the aligned estimate, in the reference's plane."""
    position_m: FloatArray
    """(N,) distance between estimate and reference."""
    heading_rad: FloatArray | None
    """(N,) estimate minus reference, in [-pi, pi), or None where the reference has no heading."""


@dataclass(frozen=True)
class Accuracy:
    """Scores of one trajectory against one reference; None where the reference cannot give the number."""

    ate_rmse_m: float | None = None
    """Root mean square position error after the best rigid alignment of the whole path."""
    ate_rmse_deg: float | None = None
    """Root mean square heading error after the same alignment."""
    rpe_translation_percent: float | None = None
    """Mean over all sub-paths of all lengths."""
    rpe_rotation_deg_per_m: float | None = None
    rpe: tuple[RpeAtLength, ...] = ()
    """Relative pose errors by length of the sub-paths."""
    end_error_m: float | None = None
    """Position error at the last match: aligned at the first matched pose where the reference has headings, else by the whole path."""
    drift_percent: float | None = None
    """`end_error_m` in percent of `distance_m`."""
    distance_m: float | None = None
    """Driven between first and last match, by the reference if it has headings, else by the estimate (GPS noise adds up to distance)."""
    relations: RelationsScore | None = None
    n_reference: int = 0
    """Usable samples (or relations) of the reference."""
    n_matched: int = 0
    """Samples (or relations) of the reference that were scored."""
    n_dropped: int = 0
    """Samples that were not usable: not finite or of a repeated stamp."""
    overlap: float = 0.0
    """Part of the trajectory's duration between first and last match, 0 to 1."""
    reference_T_world: FloatArray | None = field(default=None, compare=False)
    """(3,) the alignment by the whole path: puts the trajectory's poses into the reference's plane."""
    errors: ErrorSeries | None = field(default=None, compare=False)
    warnings: tuple[Message, ...] = ()
    """Remarks on the numbers."""

    def numbers(self) -> dict[str, float | int | None]:
        """Every number of the scores by name, as they go into a metrics file; those of the relations begin with ``relations_``."""
        scalars = {
            f.name: getattr(self, f.name)
            for f in fields(self)
            if f.name not in ("rpe", "relations", "reference_T_world", "errors", "warnings")
        }
        for group in ("all", "short", "long"):
            errors: RelationErrors | None = getattr(self.relations, group, None)
            for f in fields(RelationErrors):
                scalars[f"relations_{group}_{f.name}"] = getattr(errors, f.name, None)
        return scalars


def evaluate(
    trajectory: Trajectory,
    reference: ReferenceTrack | Relations,
    config: EvaluateConfig | None = None,
    driven: Trajectory | None = None,
) -> Accuracy:
    """Score a trajectory. Where positions alone are measured, whose noise is no way, the distance driven is that of ``driven``: the poses
    that do not jump, where ``trajectory`` is corrected by what was found later. Raises `EvaluationError` if trajectory and reference share
    no time, or too little of it."""
    config = config or EvaluateConfig()
    if isinstance(reference, Relations):
        return _evaluate_relations(trajectory, reference, config)
    return _evaluate_track(trajectory, reference, config, trajectory if driven is None else driven)


def match(trajectory: Trajectory, reference: ReferenceTrack, max_gap_s: float) -> tuple[FloatArray, ReferenceTrack]:
    """The estimate (M, 3) at the reference's stamps, and the part of the reference that it covers.

    The estimate is interpolated to the reference, never the other way: a constant twist between poses is close to the truth at an
    odometry's rate, and not at a GPS's. Raises `EvaluationError` if fewer than three samples match.
    """
    use = trajectory.covers(reference.stamps_ns, max_gap_s)
    if np.count_nonzero(use) < _MIN_MATCHES:
        inside = int(np.count_nonzero(trajectory.covers(reference.stamps_ns)))
        if inside < _MIN_MATCHES:
            raise EvaluationError(no_overlap_message(trajectory.stamps_ns, reference.stamps_ns, reference.source, inside))
        raise EvaluationError(
            f"{inside} samples of {reference.source} lie within the trajectory's time, but only {np.count_nonzero(use)} of them between "
            f"poses at most {max_gap_s:g} s apart; {_MIN_MATCHES} are needed. Allow larger gaps if interpolation over them is good enough."
        )
    part = replace(
        reference,
        stamps_ns=reference.stamps_ns[use],
        positions=reference.positions[use],
        yaws=None if reference.yaws is None else reference.yaws[use],
        covariances=None if reference.covariances is None else reference.covariances[use],
    )
    return trajectory.at(part.stamps_ns), part


def align(estimate: FloatArray, positions: FloatArray, yaws: FloatArray | None = None) -> FloatArray:
    """``reference_T_world`` (3,): the rigid motion that brings the estimate (N, 3) nearest to the reference's positions (N, 2).

    Where the reference stays within 10 cm RMS of one point its positions do not determine the rotation: it is the mean difference of
    headings then, or zero if the reference has no headings (which changes the position errors by no more than those 10 cm).
    """
    centre = positions.mean(axis=0)
    if math.sqrt(np.mean(np.sum((positions - centre) ** 2, axis=1))) > 0.1:
        return se2.align_points(estimate[:, :2], positions)
    turn = np.zeros(1) if yaws is None else yaws - estimate[:, 2]
    theta = math.atan2(np.mean(np.sin(turn)), np.mean(np.cos(turn)))
    return np.array([*(centre - se2.transform([0.0, 0.0, theta], estimate[:, :2].mean(axis=0))), theta])


def relative_pose_errors(estimate: FloatArray, reference: FloatArray, config: EvaluateConfig) -> tuple[RpeAtLength, ...]:
    """Drift per distance, as on KITTI (Geiger, Lenz, Urtasun, 2012), of matched poses (N, 3) and (N, 3).

    Distance is that along the reference, whose nodes (`path_nodes`) are the possible ends of a sub-path. From every node a sub-path of
    each length L leads to the first node that lies L or more further on; it is left out if that one lies beyond 2 L (a gap in the
    reference). With reference motion ``r`` and estimated motion ``e`` from end to end, its error is ``between(r, e)``: the norm of
    the translation, and the absolute rotation, each divided by the distance really driven. All sub-paths count alike.
    """
    if not all(length > 0 for length in config.rpe_distances_m):
        raise EvaluationError(f"distances for the relative pose error must be positive, found {config.rpe_distances_m}.")
    nodes, distance = path_nodes(reference[:, :2], config.path_resolution_m)
    est, ref = estimate[nodes], reference[nodes]
    scores = []
    for length in config.rpe_distances_m or _default_lengths(float(distance[-1])):
        # the tolerance keeps sums such as 10 * 0.1 from missing their mark by a rounding
        end = np.searchsorted(distance, distance + length * (1.0 - 1e-9))
        start = np.flatnonzero(end < len(nodes))
        end = end[start]
        driven = distance[end] - distance[start]
        whole = driven <= 2.0 * length
        start, end, driven = start[whole], end[whole], driven[whole]
        if not start.size:
            continue
        error = se2.between(se2.between(ref[start], ref[end]), se2.between(est[start], est[end]))
        translation, rotation = np.hypot(error[:, 0], error[:, 1]) / driven, np.abs(error[:, 2]) / driven
        scores.append(RpeAtLength(float(length), start.size, 100.0 * float(translation.mean()), math.degrees(rotation.mean())))
    return tuple(scores)


def score_relations(motions: FloatArray, relations: FloatArray) -> RelationErrors:
    """Errors of estimated motions (N, 3) against relations (N, 3), N > 0: ``inverse(relation) * motion``, all of one weight."""
    error = se2.between(relations, motions)
    translation, rotation = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
    return RelationErrors(
        n=len(error),
        translation_m=float(translation.mean()),
        translation_m2=float(np.mean(translation**2)),
        rotation_deg=float(rotation.mean()),
        rotation_deg2=float(np.mean(rotation**2)),
    )


@dataclass(frozen=True, eq=False)
class RelationSeries:
    """The estimate's motions between the instants of those relations that it covers."""

    index: IntArray
    """(N,) which of the relations."""
    spans_s: FloatArray
    """(N,) time from instant to instant, positive [s]."""
    motions: FloatArray
    """(N, 3) estimated ``start_T_end``."""
    translation_m: FloatArray
    """(N,) error of the translation, as in `score_relations`."""
    rotation_rad: FloatArray
    """(N,) absolute error of the rotation."""


def relation_errors(trajectory: Trajectory, relations: Relations, max_gap_s: float = 1.0) -> RelationSeries:
    """The error of every relation that a trajectory covers. Raises `EvaluationError` if it covers none."""
    starts, ends = relations.starts_ns, relations.ends_ns
    use = np.flatnonzero(trajectory.covers(starts, max_gap_s) & trajectory.covers(ends, max_gap_s))
    if not use.size:
        raise EvaluationError(no_overlap_message(trajectory.stamps_ns, np.sort(np.concatenate([starts, ends])), relations.source, 0))
    motions = se2.between(trajectory.at(starts[use]), trajectory.at(ends[use]))
    error = se2.between(relations.motions[use], motions)
    spans = np.abs(ends[use] - starts[use]) * 1e-9
    return RelationSeries(use, spans, motions, np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2]))


def _evaluate_track(trajectory: Trajectory, reference: ReferenceTrack, config: EvaluateConfig, driven: Trajectory) -> Accuracy:
    estimate, part = match(trajectory, reference, config.max_gap_s)
    alignment = align(estimate, part.positions, part.yaws)
    aligned = se2.compose(alignment, estimate)
    position_error = np.hypot(*(aligned[:, :2] - part.positions).T)
    heading_error = None if part.yaws is None else se2.wrap_angle(aligned[:, 2] - part.yaws)
    rpe: tuple[RpeAtLength, ...] = ()
    if part.yaws is None:
        end_error = float(position_error[-1])
        ends = driven.at(part.stamps_ns[[0, -1]])
        span = (driven.stamps_ns >= part.stamps_ns[0]) & (driven.stamps_ns <= part.stamps_ns[-1])
        path = np.vstack([ends[0, :2], driven.poses[span, :2], ends[1, :2]])
    else:
        rpe = relative_pose_errors(estimate, part.poses, config)
        start = se2.compose(part.poses[0], se2.inverse(estimate[0]))
        end_error = float(np.hypot(*(se2.transform(start, estimate[-1, :2]) - part.positions[-1])))
        path = part.positions
    distance = float(path_nodes(path, config.path_resolution_m)[1][-1])
    n_paths = sum(r.n for r in rpe)
    return Accuracy(
        ate_rmse_m=float(np.sqrt(np.mean(position_error**2))),
        ate_rmse_deg=None if heading_error is None else math.degrees(np.sqrt(np.mean(heading_error**2))),
        rpe_translation_percent=sum(r.n * r.translation_percent for r in rpe) / n_paths if rpe else None,
        rpe_rotation_deg_per_m=sum(r.n * r.rotation_deg_per_m for r in rpe) / n_paths if rpe else None,
        rpe=rpe,
        end_error_m=end_error,
        drift_percent=100.0 * end_error / distance if distance > 0 else None,
        distance_m=distance,
        n_reference=len(reference.stamps_ns),
        n_matched=len(part.stamps_ns),
        n_dropped=reference.n_dropped,
        overlap=_overlap(trajectory, part.stamps_ns),
        reference_T_world=alignment,
        errors=ErrorSeries(part.stamps_ns, aligned, position_error, heading_error),
        warnings=reference.warnings,
    )


def _evaluate_relations(trajectory: Trajectory, relations: Relations, config: EvaluateConfig) -> Accuracy:
    found = relation_errors(trajectory, relations, config.max_gap_s)
    use = found.index
    stamps = np.concatenate([relations.starts_ns[use], relations.ends_ns[use]])
    motions, truth = found.motions, relations.motions[use]
    short = found.spans_s < config.short_span_s
    score = RelationsScore(
        all=score_relations(motions, truth),
        short=score_relations(motions[short], truth[short]) if short.any() else None,
        long=score_relations(motions[~short], truth[~short]) if not short.all() else None,
    )
    return Accuracy(
        relations=score, n_reference=len(relations.starts_ns), n_matched=len(use), overlap=_overlap(trajectory, np.sort(stamps))
    )


def _overlap(trajectory: Trajectory, stamps_ns: IntArray) -> float:
    span = int(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0])
    return float(stamps_ns[-1] - stamps_ns[0]) / span if span else 1.0


def _default_lengths(driven: float) -> list[float]:
    decades = range(math.ceil(math.log10(max(driven, 1.0))) + 1)
    return [factor * 10.0**decade for decade in decades for factor in (1.0, 2.0, 5.0) if factor * 10.0**decade <= driven]
