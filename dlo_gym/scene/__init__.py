"""The dual-arm cell in MuJoCo: arms, table, cameras, renderer."""
