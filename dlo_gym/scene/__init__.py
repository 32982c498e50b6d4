"""The dual-arm cell in MuJoCo: arms, table, cameras, renderer.

``SceneRenderer`` is in ``dlo_gym.scene.renderer``, ``SceneConfig`` and ``default_cameras`` in
``dlo_gym.scene.builder``, ``DualArm`` in ``dlo_gym.scene.arms``, which needs no MuJoCo.
"""
