"""Four skidding wheels: contact laws, their equilibrium forward and inverse, the motion model, and its dynamic form."""

from motion_models.friction.model import CorrectedFriction, FrictionModel, check_parameters, floor_of

__all__ = ["CorrectedFriction", "FrictionModel", "check_parameters", "floor_of"]
