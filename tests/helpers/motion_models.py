"""Random parameters and drives of motion models, and their numerical derivatives."""

import numpy as np


def some_params(model, rng):
    """A robot like the nominal one, but without its symmetries."""
    p = model.nominal
    found = p * (1 + 0.1 * rng.uniform(-1, 1, p.shape)) + np.where(p == 0, 0.02 * rng.uniform(-1, 1, p.shape), 0)
    if "scrub" in model.param_names:  # a moment that helped a turn would allow two motions for one pair of wheel rates
        found[model.param_names.index("scrub")] *= np.sign(found[model.param_names.index("scrub")])
    return found


def some_drive(rng, n):
    """Wheel rates (n, 2) of all kinds, and CGs (n, 2) over most of the wheelbase."""
    wheels = rng.uniform(-6, 6, (n, 2))
    return wheels, rng.uniform(-1, 1, (n, 2)) * [0.2, 0.2]


def differences(f, x, j):
    """Central differences of f by x[..., j] with four steps: a long one has the curvature of f in it, a short one rounding."""
    e = np.zeros(x.shape[-1])
    e[j] = 1.0
    scale = max(1.0, float(np.max(np.abs(x[..., j]))))
    return [(f(x + h * e) - f(x - h * e)) / (2 * h) for h in scale * 10.0 ** np.arange(-4, -8, -1)]


def assert_one_agrees(exact, quotients):
    """At least one of the difference quotients agrees with the exact derivative, entry by entry."""
    error = np.min([np.abs(q - exact) / (1 + np.abs(exact)) for q in quotients], axis=0)
    assert error.max() < 1e-6
