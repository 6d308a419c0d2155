"""Measurement models, one file each: residual and Jacobians by the names of variables. Perturbations act on the right."""
