"""What is not nominal in a step: small objects with a state of their own, used before or after the straight line of the filter."""
