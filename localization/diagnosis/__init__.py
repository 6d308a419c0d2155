"""Why wheels and LiDAR differ: what a model gets wrong, the cause's name, and what naming it gains."""
