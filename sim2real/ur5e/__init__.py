"""A real UR5e: a streaming client in a process of its own.

``UR5eArm`` is in ``sim2real.ur5e.handle``, ``UR5eSettings`` in ``sim2real.ur5e.settings``. The
client process (``process``, ``rtde_client``, ``setpoint``, ``shared_state``, ``robot_clock``,
``dashboard``) imports no NumPy: it is up in a tenth of a second.
"""
