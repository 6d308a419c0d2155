"""The regressions that Ebersole 2016 prints (eqs. 4.21-4.25, Tables 4-4 to 4-7), recomputed from its 68 rotations.

python -m tests.studies.thesis_regressions
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from motion_models.calibration.regressions import (
    RotationTable,
    cor_x,
    cor_y_full,
    cor_y_lines,
    cor_y_multivariate,
    read_rotation_table,
    rotation_ratio,
)
from motion_models.se2 import FloatArray
from motion_models.skid_steer import SkidSteer, YcrVariant, thesis_coefficients

DATA = Path(__file__).parent.parent / "data" / "vaultbot"


def grid() -> RotationTable:
    """Tables 4-1 to 4-3."""
    return read_rotation_table(DATA / "rotation_grid.csv")


@dataclass(frozen=True)
class Printed:
    """A number of the thesis beside its recomputation."""

    what: str
    printed: str
    value: float
    digits: int
    """Decimals that the thesis prints, or significant digits of a number in scientific notation; it drops trailing zeros."""

    @property
    def agrees(self) -> bool:
        """To every printed digit."""
        rounded = f"{self.value:.{self.digits - 1}E}" if "E" in self.printed else f"{self.value:.{self.digits}f}"
        return Decimal(rounded) == Decimal(self.printed)


def _numbers(what: str, printed: str, values: FloatArray, digits: int | None = None) -> list[Printed]:
    """One `Printed` for each word of ``printed``; its own digits where ``digits`` are not given."""
    found = []
    for i, (text, value) in enumerate(zip(printed.split(), np.atleast_1d(values), strict=True)):
        mantissa = text.split("E")[0]
        own = len(mantissa.replace("-", "").replace(".", "")) if "E" in text else len(mantissa.partition(".")[2])
        found.append(Printed(f"{what}, {i + 1}" if np.size(values) > 1 else what, text, float(value), own if digits is None else digits))
    return found


def printed_numbers() -> list[Printed]:
    """Everything that is printed of 4.22 to 4.24 and in Tables 4-4 to 4-7."""
    table = grid()
    line = cor_x(table)
    plane = cor_y_multivariate(table)
    rss, tss, residual_df = plane.residual_ss, plane.total_ss, plane.residual_df
    regression_ss = tss - rss
    x, slope, intercept = cor_y_lines(table)
    # The thesis fitted 4.24 to Table 4-7 as it prints it, rounded to four decimals.
    slopes, intercepts = cor_y_full(x, slope.round(4), intercept.round(4))
    low, high = plane.interval().T
    return [
        *_numbers("4.22 slope, intercept", "2.1722 -0.0635", line.coefficients[::-1]),
        *_numbers("fig. 4-7 R^2", "0.9931", np.array(line.r_squared)),
        *_numbers("4.23 x_G, y_G, intercept", "-0.166 -1.295 -0.0006", plane.coefficients[[1, 2, 0]]),
        *_numbers("Table 4-4 multiple R", "0.92588449", np.array(np.sqrt(plane.r_squared))),
        *_numbers("Table 4-4 R^2", "0.857262088", np.array(plane.r_squared)),
        *_numbers("Table 4-4 adjusted R^2", "0.852870153", np.array(plane.adjusted_r_squared)),
        *_numbers("Table 4-4 standard error", "0.011301514", np.array(plane.standard_error)),
        *_numbers("Table 4-4 observations", "68", np.array(plane.observations)),
        *_numbers("Table 4-5 degrees of freedom", "2 65 67", np.array([plane.regression_df, residual_df, residual_df + 2])),
        *_numbers("Table 4-5 sums of squares", "0.049860985 0.008302074 0.058163059", np.array([regression_ss, rss, tss])),
        *_numbers("Table 4-5 mean squares", "0.02493 0.000128", np.array([regression_ss / 2, rss / residual_df])),
        *_numbers("Table 4-5 F", "195.190034", np.array(plane.f_statistic)),
        *_numbers("Table 4-5 significance of F", "3.33065E-28", np.array(plane.significance)),
        *_numbers("Table 4-6 coefficients", "-0.000571511 -0.166202827 -1.295038168", plane.coefficients),
        *_numbers("Table 4-6 standard errors", "0.001524523 0.024411906 0.069820984", plane.sigma),
        *_numbers("Table 4-6 t", "-0.37488 -6.80827 -18.548", plane.t_statistics),
        *_numbers("Table 4-6 p", "0.70897122 3.7791E-09 1.1692E-27", plane.p_values),
        *_numbers("Table 4-6 lower 95 %", "-0.003616194 -0.214956769 -1.434480302", low),
        *_numbers("Table 4-6 upper 95 %", "0.002473172 -0.117448885 -1.155596034", high),
        *_numbers("Table 4-7 slopes", "-1.275 -1.4964 -1.6964 -1.5786 -1.6143 -1.6179 -1.3429 -1.0321 -0.4179 -0.13", slope, 4),
        *_numbers("Table 4-7 intercepts", "0.0156 0.0069 0.0009 -0.0001 -0.006 -0.011 -0.0164 -0.0184 -0.0159 -0.0072", intercept, 4),
        *_numbers("4.24 slope's x_G^2, x_G, 1", "115.18 -0.2808 -1.6955", slopes.coefficients[::-1]),
        *_numbers("4.24 intercept's x_G^2, x_G, 1", "1.5852 -0.2512 -0.0043", intercepts.coefficients[::-1]),
    ]


def k_deviation() -> float:
    """Largest relative difference of k over the grid, between 4.21 as printed and as recomputed from the rounded table."""
    table = grid()
    x = table.cg[:, 0]
    recomputed = np.polynomial.polynomial.polyval(x, rotation_ratio(table).coefficients)
    printed = 0.9541 + 0.1056 * x + 46.902 * x**2
    return float(np.max(np.abs(recomputed / printed - 1.0)))


@dataclass(frozen=True)
class VariantError:
    """Root mean square errors over the 68 rows of the heuristic with one of its forms of y_CR."""

    variant: YcrVariant
    ratio: float
    x_cr: float
    """[m]"""
    y_cr: float
    """[m]"""


def variant_errors() -> list[VariantError]:
    """The heuristic as printed, with 4.23, 4.24 and 4.25."""
    table = grid()
    found = []
    for variant in ("multivariate", "full", "symmetric"):
        coefficients = thesis_coefficients(variant)
        k, x_cr, y_cr = SkidSteer(1.0, 1.0, coefficients).rotation(table.cg, coefficients)
        errors = np.stack([1.875 * k - table.ratio, x_cr - table.cor[:, 0], y_cr - table.cor[:, 1]])
        found.append(VariantError(variant, *(float(e) for e in np.sqrt(np.mean(errors**2, axis=1)))))
    return found


def main() -> None:
    numbers = printed_numbers()
    print(f"{'number of the thesis':34} {'printed':>14} {'recomputed':>16}")
    for n in numbers:
        print(f"{n.what:34} {n.printed:>14} {n.value:16.9g}  {'' if n.agrees else 'DIFFERS'}")
    print(f"\n{sum(n.agrees for n in numbers)} of {len(numbers)} agree to every printed digit.")
    a, b, c = rotation_ratio(grid()).coefficients
    print(f"4.21: printed 46.902 x^2 + 0.1056 x + 0.9541, from the rounded table {c:.3f} x^2 + {b:.4f} x + {a:.4f};")
    print(f"      k differs over the grid by {100 * k_deviation():.3f} % at most.\n")
    print(f"{'RMS error of the heuristic with':34} {'ratio':>8} {'x_CR [m]':>9} {'y_CR [m]':>9}")
    for v in variant_errors():
        print(f"{v.variant:34} {v.ratio:8.4f} {v.x_cr:9.4f} {v.y_cr:9.4f}")


if __name__ == "__main__":
    main()
