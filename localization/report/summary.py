"""Summary of a replay in words: which run is best and by how much, whether its covariances are consistent, and what to do.

A difference is reported as one only if it is significant. Errors along a drive are correlated and a few large ones (closed loops) make most
of their mean, so runs are compared by blocks and by ranks: the drive is cut into ten stretches of equally many samples, and the
differences of two runs' mean errors in them are tested by Wilcoxon's signed ranks, which takes the blocks and not the samples as
independent and assumes no distribution of them. Two runs whose errors differ by less than 2 % are called equally good too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2, wilcoxon

from localization.evaluation.consistency import mean_band
from localization.evaluation.metrics import Accuracy, ErrorSeries, relation_errors
from localization.evaluation.reference_fit import errors_at, find_lever, find_scatter
from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result
from localization.report.runs import (
    DEAD_RECKONING,
    WHEELLESS,
    PlottedRun,
    baseline_run,
    best_run,
    capitalize,
    headline,
    join_words,
    plotted_runs,
)
from localization.trajectory import IntArray
from motion_models.se2 import FloatArray

_DOF = 3  # x, y, heading
_BLOCKS = 10  # of a drive; errors in different tenths are taken as independent
_EQUAL_RELATIVE_ERROR = 0.02  # a smaller difference of errors has no consequence
_NOISE_FACTOR = 1.25  # errors up to it times the reference's noise are 0.75 of the noise or less: both add by squares
_MIN_SIGMA_FACTOR = 1.25  # the band of thousands of innovations is so narrow that every filter leaves it; smaller factors are not reported


_MIN_SHOWN_FACTOR = 1.5
"""In sigma; a verdict states what a drive can show where smaller errors of the covariances stay hidden."""


def verdict(results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> str:
    """The summary as one paragraph."""
    return " ".join(verdict_sentences(results, reference))


def verdict_sentences(results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> list[str]:
    """Sentences of the summary, the most important first."""
    lines = plotted_runs(results)
    if not lines:
        return ["Nothing was run."]
    best, losses = best_run(lines), _losses(lines)
    if contradictions := lines[0].result.contradictions:
        ending = "Until that is corrected, errors against this reference show nothing, and no covariance is judged."
        return [*contradictions, ending, *losses]
    if reference is None or best is None:
        line = _most_informed(lines)
        return [*_unscored(lines), *losses, *_consistency(line, f"The covariances of {line.words}"), *_inflation_reasons(lines)]
    of_point = ""
    if (lever := _lever(lines, reference)) is not None and isinstance(reference, ReferenceTrack):
        of_base = best.error
        lines = [_at_point(line, reference, lever) for line in lines]
        best = best_run(lines) or best
        of_point = _of_point(lever, of_base, reference)
    equals = equally_good(lines, best, reference)
    ranking = _ranking(lines, best, equals, reference)
    return [
        *ranking,
        *([of_point] if of_point else []),
        *losses,
        *_as_published(best),
        *_coverage(best),
        *_consistency(best),
        *(_left_out(best.result) or _exactness(best, reference)),
        *_inflation_reasons(lines),
        *_visibility(best, reference),
        *_by_errors(best, reference),
        *_advice(lines, best, equals, reference),
    ]


def _lever(lines: Sequence[PlottedRun], reference: ReferenceTrack | Relations) -> FloatArray | None:
    """(2,) ahead and to the left of base_link [m] of the point that the reference measures, by the run that it explains best; or None."""
    if isinstance(reference, Relations):
        return None
    series = [line.result.accuracy.errors for line in lines if line.result.accuracy is not None]
    found = [lever for errors in series if errors is not None and (lever := find_lever(errors, reference)) is not None]
    return min(found, key=lambda each: each[1])[0] if found else None


def _at_point(line: PlottedRun, reference: ReferenceTrack, lever: FloatArray) -> PlottedRun:
    """``line`` with the position errors of the point ``lever`` (2,) off base_link [m] in place of those of base_link."""
    accuracy, live = (
        each if each is None or each.errors is None else _with_errors(each, errors_at(each.errors, reference, lever))
        for each in (line.result.accuracy, line.result.live)
    )
    return replace(line, result=replace(line.result, accuracy=accuracy, live=live))


def _with_errors(accuracy: Accuracy, errors: ErrorSeries) -> Accuracy:
    return replace(accuracy, errors=errors, ate_rmse_m=math.sqrt(float(np.mean(errors.position_m**2))))


def _of_point(lever: FloatArray, of_base_m: float | None, reference: ReferenceTrack) -> str:
    ahead, left = lever
    along = f"{metres(abs(ahead))} {'ahead of' if ahead > 0.0 else 'behind'} base_link"
    across = f"{metres(abs(left))} to the {'left' if left > 0.0 else 'right'}"
    table = "" if of_base_m is None else f"; the table has those of base_link, from {metres(of_base_m)} on"
    return f"{capitalize(reference.source)} is of a point {along}, {across} (an antenna, a prism): these errors are of that point{table}."


def equally_good(lines: Sequence[PlottedRun], best: PlottedRun, reference: ReferenceTrack | Relations) -> list[PlottedRun]:
    """The scored runs but ``best`` that are not significantly worse on this log, or differ by less than 2 %."""
    others = [line for line in lines if line is not best and line.error is not None]
    return [
        line for line in others if is_close(line, best) or is_within_noise(line, best, reference) or not _is_worse(line, best, reference)
    ]


def is_within_noise(line: PlottedRun, best: PlottedRun, reference: ReferenceTrack | Relations) -> bool:
    """True if the error is that of the reference itself, by its covariances."""
    floor = _noise_floor(best, reference)
    return floor is not None and line.error is not None and line.error <= _NOISE_FACTOR * floor


def _noise_floor(best: PlottedRun, reference: ReferenceTrack | Relations) -> float | None:
    """The reference's noise [m] where it makes the best run's error; None where that is larger, or the noise unknown.

    An error below what the covariances state shows that the noise is smaller: a constant offset of a receiver drops out by alignment.
    """
    noise = None if isinstance(reference, Relations) else reference.position_noise_m
    if noise is None or _error(best) > _NOISE_FACTOR * noise:
        return None
    return noise if noise <= _NOISE_FACTOR * _error(best) else _error(best)


def metres(value: float) -> str:
    """A length in metres to three digits, never in scientific notation."""
    if not math.isfinite(value):
        return "an infinite distance"
    if value and value < 0.0095:
        return f"{1000.0 * value:.2g} mm"
    digits = 3 if value < 0.995 else 2 if value < 9.995 else 1 if value < 99.95 else 0
    return f"{value:,.{digits}f} m"


def is_close(line: PlottedRun, best: PlottedRun) -> bool:
    """True if the errors differ by less than 2 %, significant or not."""
    return _error(line) - _error(best) <= _EQUAL_RELATIVE_ERROR * _error(best)


def _is_worse(line: PlottedRun, best: PlottedRun, reference: ReferenceTrack | Relations) -> bool:
    """True if ``line``'s errors exceed those of ``best`` over most blocks of the drive, significant at 95 % (two-sided)."""
    difference = _differences(line, best, reference)
    if len(difference) < 2 * _BLOCKS:
        return False
    blocks = np.array([block.mean() for block in np.array_split(difference, _BLOCKS)])
    return bool(blocks.any()) and float(wilcoxon(blocks, alternative="greater", method="exact" if blocks.all() else "auto").pvalue) < 0.025


def _differences(line: PlottedRun, best: PlottedRun, reference: ReferenceTrack | Relations) -> FloatArray:
    """(N,) in order of time, of what the headline number is the mean of: relations' errors, or squared position errors."""
    if isinstance(reference, Relations):
        one, two = (relation_errors(x.result.run.trajectory, reference) for x in (line, best))
        common = np.intersect1d(one.index, two.index)
        common = common[np.argsort(reference.starts_ns[common], kind="stable")]
        return _at(one.translation_m, one.index, common) - _at(two.translation_m, two.index, common)
    series = [x.result.accuracy.errors if x.result.accuracy else None for x in (line, best)]
    if series[0] is None or series[1] is None:
        return np.empty(0)
    common = np.intersect1d(series[0].stamps_ns, series[1].stamps_ns)
    squares = [_at(s.position_m, s.stamps_ns, common) ** 2 for s in series if s is not None]
    return squares[0] - squares[1]


def _at(values: FloatArray, keys: IntArray, wanted: IntArray) -> FloatArray:
    found: FloatArray = values[np.searchsorted(keys, wanted)]
    return found


def _ranking(
    lines: Sequence[PlottedRun], best: PlottedRun, equals: Sequence[PlottedRun], reference: ReferenceTrack | Relations
) -> list[str]:
    assert best.error is not None
    measure = _measure(best, reference)
    if len(lines) == 1:
        alone = "Nothing else was run for comparison."
        return [f"{capitalize(best.words)}: {metres(best.error)} {measure}.", alone]
    near = [x for x in equals if is_close(x, best)]
    noisy = [x for x in equals if x not in near and is_within_noise(x, best, reference)]
    unproven = [x for x in equals if x not in near and x not in noisy]
    found = "has the smallest error" if equals else "is best"
    sentences = [f"{capitalize(best.words)} {found}: {metres(best.error)} {measure}{_gains([x for x in lines if x not in noisy], best)}."]
    if near:
        sentences.append(f"Within 2 % of it: {_listed(near)}.")
    if noisy:
        sentences.append(f"Within the reference's noise of it: {_listed(noisy)}.")
    if unproven:
        sentences.append(f"Not proven worse by this one drive: {_listed(unproven)}.")
    return sentences


def _listed(lines: Sequence[PlottedRun]) -> str:
    return join_words([f"{line.words} ({metres(_error(line))})" for line in lines])


def _measure(best: PlottedRun, reference: ReferenceTrack | Relations) -> str:
    accuracy = best.result.accuracy
    assert accuracy is not None
    if accuracy.relations:
        return f"mean translation error over {accuracy.relations.all.n:,} relations"
    driven = f" over {metres(accuracy.distance_m)} driven" if accuracy.distance_m else ""
    return f"position error (ATE, root mean square) against {reference.source}{driven}"


def _gains(lines: Sequence[PlottedRun], best: PlottedRun) -> str:
    """How much less the error is than that of each of the parts."""
    parts = [baseline_run(lines), next((line for line in lines if line.result.run.estimator == WHEELLESS), None)]
    gains = []
    for part in parts:
        if part is None or part is best or part.error is None or is_close(part, best):
            continue
        less = 100.0 * (1.0 - _error(best) / part.error)
        rounded = f"{math.floor(less)}" if less < 99.0 else f"{math.floor(10.0 * min(less, 99.9)) / 10.0:.1f}"  # never up to all of it
        gains.append(f"{rounded} % less than {part.words} ({metres(part.error)})")
    return ", " + join_words(gains) if gains else ""


def _losses(lines: Sequence[PlottedRun]) -> list[str]:
    """Runs without LiDAR for long, and what to do: without scores they are not recommended, while a measured error includes those times."""
    lost = [(line, line.result.run.lidar) for line in lines if line.is_lost]
    if not lost:
        return []
    advice = dict.fromkeys(losses.advice for _, losses in lost if losses is not None)
    if any(line.error is not None for line in lines):
        parts = [f"{line.words} ({losses.summary})" for line, losses in lost if losses is not None]
        return [f"Part of the way is without the LiDAR in {join_words(parts)}; the errors include that.", *advice]
    parts = [f"{line.words}: {losses.summary}" for line, losses in lost if losses is not None]
    return [f"Not recommended are {'; '.join(parts)}." if len(parts) > 1 else f"Not recommended is {parts[0]}.", *advice]


def _inflation_reasons(lines: Sequence[PlottedRun]) -> list[str]:
    """Why covariances are wide, without a fault."""
    return [f"{line.words}: {reason}" for line in lines for reason in line.result.run.inflation_reasons]


def _as_published(best: PlottedRun) -> list[str]:
    """Error of the poses as they were published, where loop closures have smoothed them, or what is found at rest has corrected them."""
    run, then = best.result.run, headline(best.result.live)
    loops = run.counts.get("loops", 0)
    if then is not None and run.hindsight == "gyro bias":
        return [f"That is the trajectory as corrected later by the gyro's bias; the poses that were published live had {metres(then)}."]
    if not loops or then is None:
        return []
    places = "a place" if loops == 1 else f"{loops} places"
    return [f"That is the smoothed trajectory, with loop closures at {places}; as it drove, its error was {metres(then)}."]


def _coverage(best: PlottedRun) -> list[str]:
    accuracy = best.result.accuracy
    if accuracy is None or accuracy.overlap >= 0.9:
        return []
    return [f"The reference covers only {100.0 * accuracy.overlap:.0f} % of the drive's time."]


_LESS_THAN_NOISE = "wheels and scans agree better than their covariances predict"


def _consistency(line: PlottedRun, whose: str = "Its covariances") -> list[str]:
    """Whether the covariances are consistent: by NIS over many scans; by NEES only where a single drive is enough to reject it."""
    run, nees = line.result.run, line.result.nees_mean
    if run.trajectory.covariances is None:
        return [f"{capitalize(line.words)} gives no covariance."]
    known = run.nis[np.isfinite(run.nis)]
    results_, by_pose = [], ""
    if len(known) >= 20:
        verdict_, text = _test("NIS", float(known.mean()), mean_band(len(known), _DOF), "innovations")
        middle, expected = float(np.median(known)), float(chi2.median(_DOF))
        if verdict_ == "over" and middle < expected * _MIN_SIGMA_FACTOR**2:
            text += f" in the mean, but most fit (median {middle:.1f}, {expected:.1f} expected), so some outliers make it"
        results_.append((verdict_, text))
    if nees is not None and not math.isnan(nees) and not _left_out(line.result):
        results_.append(_test("NEES", nees, _nees_band(line.result), "errors"))
        if explained := _by_scatter(line.result, nees, [word for word, _ in results_[:-1]]):
            results_[-1] = ("fits", explained)
        by_pose = results_[-1][0]
    elif (distances := line.result.position_nees) is not None:
        results_.append(_test("NEES of distances", distances.mean, distances.band, "errors", dof=1))
        by_pose = results_[-1][0]
    if (stretches := line.result.stretch_nees) is not None:
        dof = round(stretches.dof)
        results_.append(_test(f"NEES over {stretches.n} stretches", stretches.mean, stretches.band, "errors", dof))
    elif by_pose == "fits":
        results_[-1] = ("fits", results_[-1][1] + _shown(line.result))
    found = {word: [text for verdict_, text in results_ if verdict_ == word] for word in ("over", "under", "fits")}
    if found["over"] and by_pose in ("fits", "under"):
        also = f"{whose} are not too small by the reference ({join_words([*found['fits'], *found['under']])})"
        cause = "Wheels slip, or the mount, the stamps or the scale of a sensor is wrong: run `skidloc diagnose` on the log."
        return [f"{also}, but wheels and scans differ by more than their covariances predict: {found['over'][0]}.", cause]
    if found["over"]:
        also = f" ({join_words([*found['under'], *found['fits']])})" if found["under"] or found["fits"] else ""
        return [f"{whose} are overconfident: {join_words(found['over'])}{also}. Enlarge them before fusing them elsewhere."]
    also = f" ({join_words(found['fits'])})" if found["fits"] else ""
    if found["under"] and by_pose == "under":
        return [f"{whose} are larger than need be: {join_words(found['under'])}{also}; safe to fuse, but given less weight than is due."]
    if found["under"] and by_pose == "fits":
        return [f"{whose} fit the reference: {join_words(found['fits'])}; {_LESS_THAN_NOISE} ({found['under'][0]})."]
    if found["under"]:  # innovations are of one step: they test the noise of wheels and scans, not the pose's covariance
        unknown = "whether those of the pose are too large, only a reference with headings can show"
        return [f"{whose} are not too small: {_LESS_THAN_NOISE} ({found['under'][0]}){also}; {unknown}."]
    if found["fits"]:
        return [f"{whose} are consistent: {join_words(found['fits'])}."]
    return [f"{whose} could not be tested: that takes scans, or a reference with headings or with covariances of its positions."]


def _left_out(result: Result) -> list[str]:
    """That NEES is no test where most poses are left out of it."""
    counted, left_out = result.nees_counts or (0, 0)
    if left_out <= counted:
        return []
    poses = counted + left_out
    return [f"NEES is not judged: it is of {counted} of {poses} poses, as the covariances of the others shrink along the drive."]


def _by_scatter(result: Result, nees: float, innovations: Sequence[str]) -> str:
    """That the scatter of a reference without covariances explains the errors beyond theirs, where innovations fit as well; else ""."""
    if (scatter := result.scatter_nees) is None or innovations != ["fits"] or scatter.consistency.verdict == "overconfident":
        return ""
    noise = f"{metres(scatter.sigma_m)} and {math.degrees(scatter.sigma_rad):.2g} deg"
    return (
        f"mean NEES {scatter.consistency.mean:.3g}, where {_DOF} is expected, with {noise} by which the poses of the reference scatter from"
        f" one to the next ({nees:.3g} if it were exact)"
    )


def _shown(result: Result) -> str:
    """Which errors of the covariances the few independent samples of one drive show."""
    dof, band = _DOF, _nees_band(result)
    if result.nees_mean is None and result.position_nees is not None:
        dof, band = 1, result.position_nees.band
    factor = math.sqrt(band[1] / dof)
    return f"; on so short a drive sigmas that are less than {factor:.1f} times too small stay hidden" if factor > _MIN_SHOWN_FACTOR else ""


def _exactness(best: PlottedRun, reference: ReferenceTrack | Relations) -> list[str]:
    """That large NEES may be the reference's noise, where that is unknown."""
    nees = best.result.nees_mean
    if not isinstance(reference, ReferenceTrack) or reference.covariances is not None or nees is None or nees <= _nees_band(best.result)[1]:
        return []
    if best.result.scatter_nees is not None and best.result.scatter_nees.consistency.verdict != "overconfident":
        return ["The scatter may be the reference's or the estimate's: pass the reference's noise with --reference-sigma."]
    return ["NEES takes this reference as exact, because it has no covariances: pass its noise with --reference-sigma."]


def _nees_band(result: Result) -> tuple[float, float]:
    """Band of the mean NEES; of one sample where the number of independent ones is not known."""
    return mean_band(1, _DOF) if result.nees_band is None else result.nees_band


def _visibility(best: PlottedRun, reference: ReferenceTrack | Relations) -> list[str]:
    """Which errors the reference's own noise hides."""
    floor = _noise_floor(best, reference)
    if floor is None or isinstance(reference, Relations) or reference.position_noise_m is None:
        return []
    noise = "" if floor == reference.position_noise_m else f" of {metres(reference.position_noise_m)}"
    return [f"Errors below {metres(floor)} cannot be seen with {reference.source}, by its own covariances{noise}."]


def _by_errors(best: PlottedRun, reference: ReferenceTrack | Relations) -> list[str]:
    """The scatter of a reference without covariances, by the errors."""
    errors = None if best.result.accuracy is None else best.result.accuracy.errors
    if errors is None or isinstance(reference, Relations):
        return []
    found = []
    scatter = find_scatter(errors, reference) if reference.position_noise_m is None else None
    if scatter is not None:
        found.append(
            f"The positions of {reference.source} scatter by {metres(scatter)} from one to the next: errors below that cannot be seen"
            " with it, and its slower errors are in all errors here."
        )
    return found


def _test(name: str, mean: float, band: tuple[float, float], what: str, dof: int = _DOF) -> tuple[str, str]:
    """("over" | "under" | "fits", words). Beyond the band it must be by a factor in sigma that matters, too."""
    factor = math.sqrt(mean / dof)
    value = "infinite" if math.isinf(mean) else f"{mean:.3g}" if mean < 99.5 else f"{mean:,.0f}"
    text = f"mean {name} {value}, where {dof} is expected"
    if mean > band[1] and factor > _MIN_SIGMA_FACTOR:
        return "over", text if math.isinf(mean) else f"{text}, {what} {factor:.1f} times their sigma"
    if mean < band[0] and factor < 1.0 / _MIN_SIGMA_FACTOR:
        return "under", f"{text}, {what} {factor:.2g} times their sigma"
    return "fits", f"{text} (up to {band[1]:.1f} by chance)" if factor > _MIN_SIGMA_FACTOR else text


def _advice(
    lines: Sequence[PlottedRun], best: PlottedRun, equals: Sequence[PlottedRun], reference: ReferenceTrack | Relations
) -> list[str]:
    if len(lines) == 1:
        return ["Run a second model or estimator to compare it with."]
    with_lidar = [line for line in lines if line.result.run.estimator != DEAD_RECKONING and len(line.result.run.map_points)]
    if best.result.run.estimator == DEAD_RECKONING and with_lidar and not any(line in equals for line in with_lidar):
        return ["The LiDAR made no run better than the wheels alone: check its mount, its stamps and its range in the robot file first."]
    base = baseline_run(lines)
    if base is not None and base is not best and is_within_noise(base, best, reference):
        return ["Whether it is better than dead reckoning takes a reference of less noise (RTK, mocap, a surveyed map)."]
    if base is not None and base in equals:
        return ["Confirm on another drive, before relying on it, that it is better than dead reckoning."]
    if (by_wheels := _better_by_wheels(lines, best, reference)) is not None:
        return [by_wheels]
    if any(line.result.run.estimator == best.result.run.estimator for line in equals):
        return [f"Use {best.result.run.estimator}; which motion model is better in it is not significant on this drive."]
    return [f"Use {best.words}."]


def _better_by_wheels(lines: Sequence[PlottedRun], best: PlottedRun, reference: ReferenceTrack | Relations) -> str | None:
    """To use the best estimator with another motion model, of which dead reckoning is better by more than the estimator is worse."""
    estimator = best.result.run.estimator
    by_wheels = {line.model: line for line in lines if line.result.run.estimator == DEAD_RECKONING and line.error is not None}
    own = by_wheels.get(best.model)
    alike = [x for x in lines if x.result.run.estimator == estimator and x.error is not None and x.model in by_wheels]
    if estimator == DEAD_RECKONING or own is None or best not in alike:
        return None
    line = min(alike, key=lambda each: _error(by_wheels[each.model]))
    other = by_wheels[line.model]
    if not _is_worse(own, other, reference) or _error(line) - _error(best) > _error(own) - _error(other):
        return None
    return (
        f"Use {line.words} ({metres(_error(line))}): where scans fail the robot drives by its wheels alone, whose error is"
        f" {metres(_error(other))} with {line.model}, and {metres(_error(own))} with {best.model}."
    )


def _unscored(lines: Sequence[PlottedRun]) -> list[str]:
    """Summary without a reference: how far apart the runs end."""
    advice = "Pass --reference with a pose or GPS topic, a TUM file or a relations file to have them scored."
    if len(lines) == 1:
        line = lines[0]
        driven = metres(line.result.run.driven_m)
        return [f"No reference was given: {line.words} drove {driven}, its accuracy is unknown.", advice]
    found = [(gap, a, b) for i, a in enumerate(lines) for b in lines[i + 1 :] if (gap := _separation(a, b)) is not None]
    apart = []
    if found:
        gap, a, b = max(found, key=lambda each: each[0])
        driven = metres(max(line.result.run.driven_m for line in lines))
        apart = [f"After {driven} at most, {a.words} and {b.words} are farthest apart, by {metres(gap)} at the last moment of both."]
    return ["No reference was given, so which run is right is unknown.", *apart, advice]


def _most_informed(lines: Sequence[PlottedRun]) -> PlottedRun:
    """Without scores: the last run that has covariances and, if any has, innovations to test them by."""
    return max(lines, key=lambda x: (x.result.run.trajectory.covariances is not None, x.result.nis_mean is not None, x.number))


def _separation(a: PlottedRun, b: PlottedRun) -> float | None:
    """Distance of two runs at the last moment that both have [m]; None without such."""
    both = [line.result.run.trajectory for line in (a, b)]
    if not all(len(t) for t in both):
        return None
    (first,), (second,) = (t.at([min(int(t.stamps_ns[-1]) for t in both)]) for t in both)
    return None if np.isnan(first[0] + second[0]) else math.dist(first[:2], second[:2])


def _error(line: PlottedRun) -> float:
    assert line.error is not None
    return line.error
