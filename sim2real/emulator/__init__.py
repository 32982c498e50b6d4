"""UR e-Series controllers and the world around them, emulated on loopback addresses."""
