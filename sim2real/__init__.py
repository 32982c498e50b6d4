"""Real UR5e cells; empty until the simulated loop leaves the simulator."""
