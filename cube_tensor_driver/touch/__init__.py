"""What presses on the skin: the traction on its surface from all cubes, and contacts."""
