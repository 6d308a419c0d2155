"""A physical skid-steer robot with arms, sensors and a world, that writes real bags. It knows nothing of the models under test."""
