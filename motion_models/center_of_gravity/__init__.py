"""Centre of gravity of a robot with arms and payload."""
