"""Scores of a trajectory against a reference. Their definitions are in `localization.evaluation.metrics`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from localization.trajectory import IntArray
from motion_models.se2 import FloatArray


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
    """The same by length."""
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
    """Those that were scored."""
    n_dropped: int = 0
    """Samples that were not usable: not finite or of a repeated stamp."""
    overlap: float = 0.0
    """Part of the trajectory's duration between first and last match, 0 to 1."""
    reference_T_world: FloatArray | None = field(default=None, compare=False)
    """(3,) the alignment by the whole path: puts the trajectory's poses into the reference's plane."""
    errors: ErrorSeries | None = field(default=None, compare=False)
    warnings: tuple[str, ...] = ()
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
