"""Controllers that steer the rod to a goal shape, and the safety gate they pass."""
