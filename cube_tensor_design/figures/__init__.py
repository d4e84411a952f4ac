"""Pictures of finite elements and studies, drawn by matplotlib."""
