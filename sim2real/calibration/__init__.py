"""Camera calibration: intrinsics, and extrinsics to both robot bases."""
