"""Real cells of two UR5e arms and fixed cameras, and their emulation."""
