"""The commands fem, study and paper: one file each, with arguments, work and display."""
