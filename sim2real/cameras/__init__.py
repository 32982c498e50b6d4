"""Cameras as devices: each has a camera model and gives stamped images from its own thread."""
