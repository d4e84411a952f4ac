"""Skins on the bodies of a MuJoCo model."""
