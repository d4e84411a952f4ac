"""What people look at: the live table, plots, the browser view."""
