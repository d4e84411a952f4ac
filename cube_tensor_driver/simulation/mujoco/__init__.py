"""Skins on bodies of a MuJoCo model."""
